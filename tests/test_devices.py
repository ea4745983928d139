"""Data parallelism: eight virtual devices of one process learn what one device learns."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from tagjax.training.devices import check_batch, copied, spread

STEPS = """
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
    state, numbers = flow_step(state, [{"clean": p, "seen": p} for p in pairs], optimizer, settings, 10.0)
    losses.append(numbers["loss"])
weight = np.asarray(state.network.upsampler.weight).ravel().tolist()
where = len(state.network.upsampler.weight.sharding.device_set)
try:
    flow_step(state, [{"clean": p, "seen": p} for p in pairs[:6]], optimizer, settings, 10.0)
except ValueError as error:
    refused = str(error)
print(json.dumps({"losses": losses, "weight": weight, "devices": jax.device_count(), "where": where, "refused": refused}))
"""


def _learn(devices: int) -> dict:
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    done = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_eight_devices_learn_what_one_learns():
    one, eight = _learn(1), _learn(8)
    assert (one["devices"], eight["devices"]) == (1, 8)
    assert (one["where"], eight["where"]) == (1, 8)
    np.testing.assert_allclose(eight["losses"], one["losses"], rtol=1e-5)
    np.testing.assert_allclose(eight["weight"], one["weight"], atol=1e-6)
    assert one["losses"][0] != one["losses"][2]
    assert one["refused"] == ""
    assert "batch_size is 6; on 8 devices it must be a multiple of 8" in eight["refused"]


def test_one_device_leaves_everything_where_it_is():
    batch = np.zeros((3, 2))
    check_batch(3)
    assert spread(batch) is batch
    assert copied(batch) is batch
