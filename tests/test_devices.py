"""Data parallelism: eight virtual devices of one process learn what one device learns."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tagjax.training.devices import check_batch, replicate, shard, unreplicate
from tagjax.training.processes import (
    DistributedSettings,
    broadcast_arrays,
    local_batch_size,
    max_over_processes,
    mean_over_processes,
)

FLOW_STEPS = """
import json
import jax, numpy as np, optax
from tagjax.flow.losses import FlowLossSettings
from tagjax.flow.pyramid import PyramidFlow
from tagjax.training.flow_step import FlowTrainState, flow_step

rng = np.random.default_rng(0)
pairs = rng.integers(0, 256, (8, 2, 16, 16, 3), np.uint8)
network = PyramidFlow(widths=(4, 4), radii=(1, 1), decoder_widths=((4,), (4,)))
optimizer = optax.sgd(0.01)
state = FlowTrainState.create(network, optimizer, seed=0)
settings = FlowLossSettings(data="photometric", occlusion=False)
losses, refused = [], ""
for _ in range(3):
    state, numbers = flow_step(state, [{"clean": p, "augmented": p} for p in pairs], optimizer, settings, 10.0)
    losses.append(numbers["loss"])
weight = np.asarray(state.network.upsampler.weight).ravel().tolist()
where = len(state.network.upsampler.weight.sharding.device_set)
try:
    flow_step(state, [{"clean": p, "augmented": p} for p in pairs[:6]], optimizer, settings, 10.0)
except ValueError as error:
    refused = str(error)
print(json.dumps({"losses": losses, "weight": weight, "devices": jax.device_count(), "where": where, "refused": refused}))
"""

# Eleven clips: ten of one shape, which are more than the devices, and one of another.
CLIP_STEPS = """
import json
import jax, numpy as np, optax
import synthetic_clips as synthetic
from tagjax.training import step as training_step
from tagjax.training.objective import ObjectiveSettings
from tagjax.training.state import TrainState
from tagjax.training.step import make_optimizer, train_step

recording = synthetic.recording(40)
clips = [synthetic.load(recording, 2 * n, 2 * n + 12) for n in range(10)]
clips.insert(4, synthetic.load(recording, 6, 18, epcs=["tag-a"]))
settings = ObjectiveSettings(memory=1.0, span_frames=8, skip_frames=4, max_reads=64, num_channels=4, future_stride=1)
optimizer = make_optimizer(optax.sgd(0.5), 10.0)
state = TrainState.create(synthetic.SmallTracer(40.0, 0.0), optimizer, seed=0)
ran = set()
side_by_side = training_step._gradients_side_by_side
def watched(*arguments):
    found = side_by_side(*arguments)
    ran.add(len(found[1]["loss"].sharding.device_set))
    return found
training_step._gradients_side_by_side = watched
rows = []
for _ in range(3):
    state, numbers = train_step(state, clips, optimizer, settings)
    rows.append(numbers)
print(json.dumps({"rows": rows, "learned": [float(x) for x in jax.tree.leaves(state.tracer)], "ran": sorted(ran)}))
"""


def _learn(steps: str, devices: int) -> dict:
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    environment["PYTHONPATH"] = str(Path(__file__).parent)
    done = subprocess.run([sys.executable, "-c", steps], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.ci
def test_eight_devices_learn_flow_as_one_does():
    one, eight = _learn(FLOW_STEPS, 1), _learn(FLOW_STEPS, 8)
    assert (one["devices"], eight["devices"]) == (1, 8)
    assert (one["where"], eight["where"]) == (1, 8)
    np.testing.assert_allclose(eight["losses"], one["losses"], rtol=1e-5)
    np.testing.assert_allclose(eight["weight"], one["weight"], atol=1e-6)
    assert one["losses"][0] != one["losses"][2]
    assert one["refused"] == ""
    assert "batch_size is 6; on 8 devices it must be a multiple of 8" in eight["refused"]


@pytest.mark.ci
def test_eight_devices_learn_tracing_as_one_does():
    one, eight = _learn(CLIP_STEPS, 1), _learn(CLIP_STEPS, 8)
    assert (one["ran"], eight["ran"]) == ([], [8])
    for mine, theirs in zip(one["rows"], eight["rows"], strict=True):
        assert mine.keys() == theirs.keys()
        for name in mine:
            assert theirs[name] == pytest.approx(mine[name], rel=1e-4, abs=1e-6), name
    np.testing.assert_allclose(eight["learned"], one["learned"], rtol=1e-5)
    assert abs(one["rows"][0]["loss"] - one["rows"][2]["loss"]) > 1e-4


def test_one_device_leaves_everything_where_it_is():
    batch = np.zeros((3, 2))
    check_batch(3)
    for leave in (shard, replicate, unreplicate, mean_over_processes, broadcast_arrays):
        assert leave(batch) is batch
    assert local_batch_size(3) == 3
    assert max_over_processes(15) == 15
    assert max_over_processes(0) == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_processes": 2}, "num_processes is 2 without a coordinator"),
        ({"num_processes": 2, "process_id": 2, "coordinator": "a:1"}, "process_id is 2; expected 0 to 1"),
        ({"num_processes": 0}, "num_processes 0; expected at least 1"),
        ({"timeout_s": 0}, "timeout_s is 0"),
    ],
)
def test_processes_that_cannot_meet_are_refused(settings: dict, message: str):
    with pytest.raises(ValueError, match=message):
        DistributedSettings(**settings)


def test_a_scheduler_that_is_not_there_is_named():
    code = (
        "from tagjax.training.processes import DistributedSettings, distributed_runtime\n"
        "with distributed_runtime(DistributedSettings(automatic=True, timeout_s=5)): pass"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "distributed.automatic is true, but JAX finds no scheduler" in done.stderr
    assert "give distributed.coordinator" in done.stderr
