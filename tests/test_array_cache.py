"""Cached arrays: computed by one of several processes, resumed after Ctrl-C or a kill, never read incomplete."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zarr

from tagjax.core.array_cache import cached_array, write_rows
from tagjax.core.types import LazyArray

SHAPE, SHARD, BLOCK = (11, 3, 2), 4, 2
WHOLE = np.arange(66, dtype=np.int16).reshape(SHAPE)
ROOT = Path(__file__).parents[1]


def make(begun: list[int], stop: Callable[[int], None] = lambda row: None, **more) -> Callable[[Path], None]:
    """Writes `WHOLE`, notes in `begun` where it is begun, and asks `stop` before every block."""

    def rows(first: int) -> Iterator[np.ndarray]:
        begun.append(first)
        for row in range(first, SHAPE[0], BLOCK):
            stop(row)
            yield WHOLE[row : row + BLOCK]

    settings = {"shape": SHAPE, "dtype": "int16", "shard": SHARD, "attributes": {}, "description": "make"} | more
    return lambda path: write_rows(path, rows, progress=False, **settings)


def stop_at(row: int, error: type[BaseException] = KeyboardInterrupt) -> Callable[[int], None]:
    def stop(now: int) -> None:
        if now == row:
            raise error

    return stop


def whole(found: LazyArray, folder: Path) -> None:
    """It is whole, and the only thing in its folder."""
    np.testing.assert_array_equal(found[:], WHOLE)
    assert [path.name for path in folder.iterdir()] == ["a.zarr"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_what_was_finished_before_an_interruption_is_not_made_again(tmp_path: Path, error: type[BaseException]) -> None:
    target, begun = tmp_path / "new" / "a.zarr", []
    for row in (6, 10):  # in the second file, and in the third
        with pytest.raises(error):
            cached_array(target, make(begun, stop_at(row, error)))
        assert not target.exists()
    whole(cached_array(target, make(begun)), target.parent)
    whole(cached_array(target, make(begun)), target.parent)
    assert begun == [0, 4, 8]


def test_an_interruption_before_anything_was_finished_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        cached_array(tmp_path / "a.zarr", make([], stop_at(2)))
    assert not list(tmp_path.iterdir())

    def broken(path: Path) -> None:
        path.mkdir()
        raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        cached_array(tmp_path / "a.zarr", broken)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="11 rows for an array of 12"):
        cached_array(tmp_path / "a.zarr", make([], shape=(12, 3, 2)))


@pytest.mark.parametrize("damage", ["half", "mark", "shape", "array", "unmarked"])
def test_what_cannot_be_gone_on_with_is_made_again(tmp_path: Path, damage: str) -> None:
    target, begun = tmp_path / "a.zarr", []
    with pytest.raises(KeyboardInterrupt):
        cached_array(target, make(begun, stop_at(10)))
    place = tmp_path / ".a.zarr.partial"
    more = {}
    if damage == "half":  # of a file that was being written
        part = place / "array" / "c" / "2" / "0" / "0"
        part.parent.mkdir(parents=True)
        part.write_bytes(b"half")
    elif damage == "mark":
        (place / "num_rows").write_text("")
    elif damage == "shape":  # of a release that cuts files otherwise
        more = {"shard": 6}
    elif damage == "array":
        (place / "array" / "zarr.json").unlink()
    else:
        (place / "num_rows").unlink()
    whole(cached_array(target, make(begun, **more)), tmp_path)
    assert begun == [0, 8 if damage == "half" else 0]


def start_maker(target: Path) -> subprocess.Popen:
    """Another process that makes the array, and hangs when it has finished two of its files."""
    code = (
        "import sys, time; from pathlib import Path; sys.path.insert(0, 'tests'); import test_array_cache as t\n"
        "def stop(row):\n"
        "    if row == 10: print('there', flush=True); time.sleep(600)\n"
        "t.cached_array(Path(sys.argv[1]), t.make([], stop))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(target)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    return process


def test_a_second_maker_waits_and_goes_on_where_the_first_was_killed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    target, begun, found = tmp_path / "a.zarr", [], []
    with start_maker(target) as first:
        second = threading.Thread(target=lambda: found.append(cached_array(target, make(begun))))
        second.start()
        result = ""
        while "another process computes a.zarr" not in result:
            time.sleep(0.01)
            result += capfd.readouterr().err
        time.sleep(0.2)
        assert second.is_alive()
        assert not begun
        first.send_signal(signal.SIGKILL)
    second.join(60)
    assert begun == [8]
    whole(found[0], tmp_path)


def test_of_many_makers_one_makes(tmp_path: Path) -> None:
    target, begun, found = tmp_path / "a.zarr", [], []

    def run() -> None:
        found.append(cached_array(target, make(begun, lambda row: time.sleep(0.01))))

    threads = [threading.Thread(target=run) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert begun == [0]
    assert len(found) == 8
    whole(found[-1], tmp_path)


def test_makers_that_fail_and_makers_that_wait_do_not_disturb_each_other(tmp_path: Path) -> None:
    """Each failure removes the lock file that the others wait for."""
    target, begun = tmp_path / "a.zarr", []
    left = [12]

    def run() -> None:
        def stop(row: int) -> None:
            left[0] -= 1
            if left[0] >= 0:
                raise RuntimeError

        while True:
            try:
                return whole(cached_array(target, make(begun, stop)), tmp_path)
            except RuntimeError:
                continue
            except AssertionError:  # one that waited is about to leave
                time.sleep(0.01)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    assert begun == [0] * 13
    whole(zarr.open_array(str(target), mode="r"), tmp_path)
