"""The reader model against measured tables, virtual tags, and simulated rooms against their own truth."""

import csv
import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic

from tagjax.radio.noise import estimate_flip_probability
from tagjax.radio.reader import DWELL_S, ReaderSettings, ReaderState, channel_at, noise_sigma_rad, read_times
from tagjax.recording import RecordingError
from tagjax.recording.virtual_tags import Track, attach_virtual_tags, load_tracks_csv, virtual_reads
from tagjax.tracing.range_windows import phase_reads, radio_windows

STILL = Track(np.linspace(0, 60, 61), np.tile([0.2, 0.1, 2.0], (61, 1)))


@pytest.mark.parametrize(("num_tags", "measured"), [(2, 37), (4, 29), (6, 25), (8, 18), (12, 15), (20, 10), (25, 8)])
def test_read_rate_follows_the_measured_table(num_tags, measured):
    """Reads a second and tag with N tags before one antenna, measured on public logs."""
    rates = [
        len(read_times(0.0, 60.0, ReaderSettings(num_tags=num_tags), np.random.default_rng(seed))) / 60
        for seed in range(5)
    ]
    np.testing.assert_allclose(np.mean(rates), measured, rtol=0.2)


def test_phase_noise_follows_the_measured_table():
    """Static tags, one channel, antenna-rail logs: sigma by RSSI."""
    for rssi, sigma in ((-46, 0.014), (-53, 0.019), (-59, 0.044), (-65, 0.070), (-67, 0.080)):
        assert abs(np.log2(noise_sigma_rad(np.array([float(rssi)]), 0.0)[0] / sigma)) < 0.7


def test_static_tag_repeats_its_phase_within_a_channel():
    settings = ReaderSettings(flip_probability=0.0, region="fixed")
    reads = virtual_reads(STILL, "A", settings, seed=0, antenna_m=np.zeros(3))
    spread = np.angle(np.exp(1j * (reads.phase_rad - reads.phase_rad[0])))
    assert 0.005 < np.std(spread) < 0.12
    codes = reads.phase_rad / (2 * np.pi) * 4096
    np.testing.assert_allclose(codes, 2 * np.rint(codes / 2), atol=1e-6)


def test_pi_flips_have_their_probability():
    reads = virtual_reads(STILL, "A", ReaderSettings(flip_probability=0.1), seed=0, antenna_m=np.zeros(3))
    share = estimate_flip_probability(reads.phase_rad, reads.time_ns * 1e-9, reads.channel_index)
    assert abs(share - 0.1) < 0.03


def test_hopping_dwells_and_offsets_are_affine():
    rng = np.random.default_rng(0)
    settings = ReaderSettings(region="fcc")
    state = ReaderState.draw(settings, rng)
    fit = np.polyfit(state.hop_table_hz, state.offset_rad, 1)
    assert 0.29e-6 < abs(fit[0]) < 0.44e-6
    assert np.std(state.offset_rad - np.polyval(fit, state.hop_table_hz)) < 0.01
    time_s = np.arange(0, 10, 0.001)
    hops = np.flatnonzero(np.diff(channel_at(time_s, state, settings)))
    np.testing.assert_allclose(np.diff(time_s[hops]), DWELL_S, atol=2e-3)
    assert len(set(state.hop_table_hz)) == 50


def test_settings_are_checked():
    with pytest.raises(ValueError, match="region"):
        ReaderSettings(region="moon")
    with pytest.raises(ValueError, match="flip_probability"):
        ReaderSettings(flip_probability=0.9)
    with pytest.raises(ValueError, match="num_tags"):
        ReaderSettings(num_tags=0)


def test_virtual_reads_reproduce_the_track():
    time_s = np.arange(40) / 7
    position = np.stack([0.2 * np.sin(time_s), 0 * time_s, 2.5 + 0.8 * np.sin(0.9 * time_s)], axis=-1)
    track = Track(time_s, position)
    reads = virtual_reads(track, "A", ReaderSettings(), seed=1, antenna_m=np.zeros(3))
    window = radio_windows(phase_reads(reads, "A", 0), jnp.asarray(time_s, jnp.float32), 5)
    distance = np.linalg.norm(position, axis=1)
    index = np.arange(6, 38)[:, None] - np.arange(4, -1, -1)
    truth = distance[index] - distance[index[:, :1]]
    error = (np.asarray(window.relative_m)[6:38] - truth)[:, -1]
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_same_seed_same_reads():
    one, same, other = (virtual_reads(STILL, "A", ReaderSettings(), seed=s, antenna_m=np.zeros(3)) for s in (0, 0, 1))
    np.testing.assert_array_equal(one.phase_rad, same.phase_rad)
    assert one.num_reads != other.num_reads or np.any(one.phase_rad != other.phase_rad)


def test_tags_at_unknown_positions_are_not_read():
    position = STILL.position_m.copy()
    position[20:30] = np.nan
    reads = virtual_reads(
        dataclasses.replace(STILL, position_m=position), "A", ReaderSettings(), seed=0, antenna_m=np.zeros(3)
    )
    time_s = reads.time_ns * 1e-9
    assert not np.any((time_s > 19) & (time_s < 30))
    assert np.any(time_s > 30)


def test_tags_are_attached_with_their_truth():
    recording = synthetic.recording(20)
    tracks = {
        2: Track(
            recording.frame_time_s(),
            np.stack([0 * recording.time_ns, 0 * recording.time_ns, 2 + 1e-9 * recording.time_ns], axis=1),
        )
    }
    tagged = attach_virtual_tags(recording, tracks, ReaderSettings(), seed=0)
    tagged.check()
    (epc,) = tagged.reads.epcs
    assert tagged.truth.tag_to_label == {epc: 2}
    np.testing.assert_allclose(tagged.truth.tag_range_m[epc], 2 + recording.frame_time_s(), rtol=1e-6)


def test_track_tables_are_checked(tmp_path):
    path = tmp_path / "tracks.csv"

    def write(rows, header=("frame", "person", "x_m", "y_m", "z_m")):
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([header, *rows])

    write([(1, 3, 0.1, 0.2, 1.5), (3, 3, 0.1, 0.2, 1.7)])
    tracks = load_tracks_csv(path, np.arange(4) / 7)
    assert list(tracks) == [3]
    np.testing.assert_allclose(tracks[3].position_m[2], [0.1, 0.2, 1.7])
    assert np.isnan(tracks[3].position_m[1]).all()
    write([(9, 3, 0, 0, 1)])
    with pytest.raises(RecordingError, match="frames 1 to 4"):
        load_tracks_csv(path, np.arange(4) / 7)
    write([(1, 3, "x", 0, 1)])
    with pytest.raises(RecordingError, match=r"1 of 1 rows rejected \(1: x_m is not a number \(line 2\)\)"):
        load_tracks_csv(path, np.arange(4) / 7)
    write([(1, 3)], header=("frame", "person"))
    with pytest.raises(RecordingError, match="x_m"):
        load_tracks_csv(path, np.arange(4) / 7)
    with pytest.raises(RecordingError, match="no such file"):
        load_tracks_csv(tmp_path / "none.csv", np.arange(4) / 7)


def test_simulated_walkers_are_a_sound_recording(small_walkers):
    small_walkers.check()
    assert small_walkers.num_frames == 25
    assert small_walkers.reads.epcs == sorted(small_walkers.truth.tag_to_label)
    assert len(small_walkers.reads.epcs) == 3
    assert np.median(small_walkers.depth[0][small_walkers.depth[0] > 0]) > 1000


def test_boxes_are_those_of_the_labels(small_walkers):
    truth = small_walkers.truth
    for t in (0, 7):
        for label in (1, 2, 3):
            rows, columns = np.nonzero(truth.labels[t] == label)
            if rows.size:
                np.testing.assert_array_equal(
                    truth.boxes_px[t, label - 1], [columns.min(), rows.min(), columns.max(), rows.max()]
                )
            else:
                assert np.isnan(truth.boxes_px[t, label - 1]).all()


def test_flow_carries_labels_to_the_next_frame(small_walkers):
    truth = small_walkers.truth
    agree, count = 0, 0
    for t in range(24):
        moved = np.asarray(truth.flow_px[t])
        person = (truth.labels[t] > 0) & ~truth.occluded[t]
        rows, columns = np.nonzero(person)
        x = np.rint(columns + moved[rows, columns, 0]).astype(int)
        y = np.rint(rows + moved[rows, columns, 1]).astype(int)
        agree += np.sum(truth.labels[t + 1][y, x] == truth.labels[t][rows, columns])
        count += len(rows)
    assert count > 100
    assert agree / count > 0.93


def test_tag_lies_on_its_person(small_walkers):
    recording = small_walkers
    k = recording.intrinsics
    inside = total = 0
    for epc, label in recording.truth.tag_to_label.items():
        for t, place in enumerate(recording.truth.tag_position_m[epc]):
            x, y = (k.fx_px * place[0] / place[2] + k.cx_px, k.fy_px * place[1] / place[2] + k.cy_px)
            box = recording.truth.boxes_px[t, label - 1]
            if np.isfinite(box).all() and 0 < x < k.width and 0 < y < k.height:
                total += 1
                inside += box[0] - 3 <= x <= box[2] + 3 and box[1] - 3 <= y <= box[3] + 3
    assert total > 5
    assert inside / total > 0.8
