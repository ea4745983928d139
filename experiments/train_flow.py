"""Train an optical-flow network without labels: on synthetic pairs, recordings, videos, folders of pictures and FlyingChairs.

python -m experiments.train_flow
python -m experiments.train_flow recipe=fine_tune 'data.sequences=[my_video.mp4]'
python -m experiments.train_flow recipe=raft
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import resumable_command
from .errors import errors_in_one_line
from .hparams_search import sweep_score
from .run_folder import check_configuration, keep_configuration


@resumable_command
def main(values: dict[str, Any], folder: Path) -> float | None:
    from tagjax.core.settings import from_mapping
    from tagjax.training.flow_config import TrainFlowConfig
    from tagjax.training.flow_run import run_flow_training
    from tagjax.training.loop import DivergedError

    config = from_mapping(TrainFlowConfig, values)
    check_configuration(folder, values)
    with errors_in_one_line("train_flow", DivergedError):
        score = run_flow_training(config, folder, on_start=lambda: keep_configuration(folder, values))
    print(f"run folder: {folder}")
    return sweep_score(score)


if __name__ == "__main__":
    main()
