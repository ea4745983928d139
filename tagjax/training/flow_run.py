"""A whole run of flow training in a folder: its inputs are images, its outputs checkpoints, logs, weights and scores."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from ..core.build import build
from ..core.folder_lock import locked_folder
from ..core.interruption import interruption
from ..core.machine import machine
from ..core.results import write_json
from ..flow.augmentation import AugmentationSettings
from ..flow.estimates import NetworkFlow, forward_flow
from ..flow.losses import FlowLossSettings
from ..flow.network import AbstractFlowNetwork
from ..flow.networks import NETWORKS
from ..flow.registry import make_flow
from ..flow.weights import load_weights, save_weights
from ..metrics.flow import FlowScores
from ..sim.flow_pairs import FlowPair
from .checkpoint import Checkpoints
from .devices import check_batch, unreplicate
from .flow_config import TrainFlowConfig
from .flow_sources import flow_dataset, installed_photographs, open_images, successive, validation_pairs
from .flow_step import FlowTrainState, flow_step
from .logging import Logger
from .loop import resume_state, train
from .optimizers import build_optimizer
from .processes import distributed_runtime, is_first
from .step import make_optimizer

_PEERS = ("zero", "dis_ultrafast", "dis_fast", "dis")
_MOVING_PX = 0.5
_WARPED_PAIRS = 8
"""Number of pairs, evenly spaced in time, of each sequence."""


def make_network(settings: Mapping[str, Any]) -> AbstractFlowNetwork:
    """The flow network of the settings. Raises `ConfigError` if `_target_` is not one of `NETWORKS`."""
    return build(settings, NETWORKS, where="flow")


def initial_network(settings: Mapping[str, Any], weights: str | None) -> AbstractFlowNetwork:
    """The network of the settings, with its initial weights. Raises the errors of `make_network`, `load_weights`."""
    network = make_network(settings)
    return network if weights is None else load_weights(network, weights)


def run_flow_training(
    config: TrainFlowConfig,
    folder: Path,
    *,
    console: Console | None = None,
    on_start: Callable[[], None] | None = None,
) -> float:
    """Train as configured and return the mean end-point error on synthetic validation pairs, pixels.

    `folder` then holds checkpoints, metrics.jsonl, metrics.json and weights.safetensors, which `data.clips.flow=<path>` uses.
    Ctrl-C and SIGTERM make it write a checkpoint and these files, and raise `KeyboardInterrupt` or `Terminated`; the run
    resumes when it is started again in the same folder. With several processes (`config.distributed`) only process 0 writes.
    The process that writes holds the folder's lock from before `on_start`, which writes what the caller adds to the folder.
    Raises `FolderLockedError` if another process holds it.
    """
    with contextlib.ExitStack() as lock:
        with distributed_runtime(config.distributed):
            if is_first():
                lock.enter_context(locked_folder(folder))
                if on_start is not None:
                    on_start()
            score_px, stopped_by = _run(config, folder, console or Console(quiet=not is_first(), markup=False))
        if stopped_by:
            raise interruption(stopped_by)
    return score_px


def _run(config: TrainFlowConfig, folder: Path, console: Console) -> tuple[float, int]:
    """The mean end-point error on validation pairs, pixels, and the signal that stopped the run or 0."""
    begun = time.perf_counter()
    network = initial_network(config.flow, config.weights)
    _check_sizes(network, config.data.variation, config.loss)
    check_batch(config.loop.batch_size)
    optimizer = make_optimizer(build_optimizer(config.optimizer), config.clip_norm)
    state = FlowTrainState.create(network, optimizer, seed=config.seed)
    shard = jax.process_index(), jax.process_count()
    samples = iter(flow_dataset(config.data, seed=config.seed, progress=config.loop.progress, shard=shard))
    held_out = validation_pairs(config.data.drawn)
    peers = {name: scores(flow_by_name(name, held_out), held_out) for name in _PEERS}
    with Checkpoints(folder / "checkpoints") as checkpoints:
        state = resume_state(state, samples, checkpoints, allowed=config.resume)
        first_step = int(state.step)
        if first_step:
            console.print(f"Resumed at step {first_step} of {config.loop.num_steps}.")
        logger = Logger(folder, config.logger, config=dataclasses.asdict(config), resume_step=first_step)

        def validate(state: FlowTrainState) -> dict[str, float]:
            errors_px = scores(predict_flow(unreplicate(state.average), held_out), held_out)
            return {f"epe_{name}": value for name, value in errors_px.items()}

        try:
            with jax.default_matmul_precision(config.matmul_precision):
                trained = train(
                    state,
                    samples,
                    update=lambda state, batch: flow_step(
                        state, batch, optimizer, config.loss, float(config.average_over)
                    ),
                    settings=config.loop,
                    logger=logger,
                    checkpoints=checkpoints,
                    validate=validate,
                    displayed=("loss", "data", "occluded_fraction") if config.data.teacher is None else ("loss",),
                )
        finally:
            logger.close()
            samples.close()
    learned = unreplicate(trained.state.average)
    errors_px = {"learned": scores(predict_flow(learned, held_out), held_out), **peers}
    steps = int(trained.state.step)
    warped = _warped(config, learned) if is_first() else {}
    summary = {
        "steps": steps,
        "epe_px": errors_px,
        **({"warped_levels": warped} if warped else {}),
        "steps_in_this_call": steps - first_step,
        "elapsed_s_in_this_call": round(time.perf_counter() - begun, 1),
        "machine": machine(),
    }
    if not is_first():
        return errors_px["learned"]["all"], trained.stopped_by
    write_json(folder / "metrics.json", summary)
    about = {
        "flow": dict(config.flow),
        "recipe": dataclasses.asdict(config),
        "photographs": installed_photographs() if config.data.drawn.photographs else [],
        **summary,
    }
    save_weights(folder / "weights.safetensors", learned, about)
    console.print(_table(errors_px))
    if warped:
        values = ", ".join(f"{name} {levels:.2f}" for name, levels in warped.items())
        console.print(f"mean difference of the sequences' images after warping, grey levels of 255: {values}")
    if trained.stopped_by:
        console.print(f"Stopped at step {steps}, which is saved.")
    return errors_px["learned"]["all"], trained.stopped_by


def _check_sizes(network: AbstractFlowNetwork, variation: AugmentationSettings, loss: FlowLossSettings) -> None:
    for name in ("height", "width", "margin_px"):
        value = getattr(variation, name)
        if value % network.divisor:
            fitting = network.divisor * max(1, round(value / network.divisor))
            raise ValueError(
                f"data.variation.{name} is {value}; this network needs multiples of {network.divisor}: set {fitting}."
            )
    if loss.self_supervision == 0:
        return
    border, half = loss.self_supervision_border_px, max(network.divisor // 2, 1)
    for name in ("height", "width"):
        left = getattr(variation, name) - 2 * border
        if left < network.divisor or left % network.divisor:
            raise ValueError(
                f"loss.self_supervision_border_px is {border}, which leaves {left} pixels of data.variation.{name}; this "
                f"network needs multiples of {network.divisor}, at least one: set a multiple of {half}, or a greater {name}."
            )


@eqx.filter_jit
def _flows(network: AbstractFlowNetwork, first: jax.Array, second: jax.Array) -> jax.Array:
    return jax.vmap(functools.partial(forward_flow, network))(first, second)


def predict_flow(network: AbstractFlowNetwork, pairs: FlowPair, batch: int = 8) -> np.ndarray:
    """The network's flow of stacked pairs of any size, first to second."""
    count = pairs.first.shape[0]
    parts = [
        np.asarray(_flows(network, pairs.first[i : i + batch], pairs.second[i : i + batch]))
        for i in range(0, count, batch)
    ]
    return np.concatenate(parts)


def flow_by_name(name: str, pairs: FlowPair) -> np.ndarray:
    """The flow of stacked pairs, estimated by the flow of this name (`tagjax.flow.registry`)."""
    flow = make_flow(name)
    first, second = (np.rint(255 * np.asarray(pictures)).astype(np.uint8) for pictures in (pairs.first, pairs.second))
    return np.stack([flow(a, b) for a, b in zip(first, second, strict=True)])


def scores(flow_px: np.ndarray, pairs: FlowPair) -> dict[str, float]:
    """Mean end-point error, pixels: over all pixels, the visible ones, the hidden ones, and the moving ones."""
    truth, hidden = np.asarray(pairs.forward_px), np.asarray(pairs.occluded_first)
    error = np.linalg.norm(flow_px - truth, axis=-1)
    moving = np.linalg.norm(truth, axis=-1) > _MOVING_PX
    chosen = {"all": np.ones_like(hidden), "visible": ~hidden, "hidden": hidden, "moving": moving}
    return {name: float(np.mean(error[mask])) if mask.any() else float("nan") for name, mask in chosen.items()}


def _warped(config: TrainFlowConfig, learned: AbstractFlowNetwork) -> dict[str, float]:
    """Mean difference between images of the sequences and the next image warped onto them, grey levels; by flow.

    The images are also training data, which is used without labels. `before` stands for the initial weights, where they
    were given. Empty without sequences.
    """
    if not config.data.sequences:
        return {}
    flows = {"learned": NetworkFlow(learned), **{name: make_flow(name) for name in _PEERS}}
    if config.weights is not None:
        flows["before"] = NetworkFlow(initial_network(config.flow, config.weights))
    total = dict.fromkeys(flows, FlowScores())
    for path in config.data.sequences:
        for first, second in successive(open_images(path, Path(config.data.drawn.folder)), _WARPED_PAIRS):
            for name, flow in flows.items():
                total[name] = total[name].merge(FlowScores.of_pictures(first, second, flow(first, second)))
    results = {name: score.result()["warped_levels"] for name, score in total.items()}
    return {name: float(levels) for name, levels in results.items() if levels is not None}


def _table(errors_px: Mapping[str, Mapping[str, float]]) -> Table:
    table = Table("flow", *next(iter(errors_px.values())), title="end-point error on synthetic validation pairs, px")
    for name, values in errors_px.items():
        table.add_row(name, *(f"{value:.3f}" for value in values.values()))
    return table
