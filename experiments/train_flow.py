"""Train an optical-flow network without labels: on drawn pairs, recordings, videos and folders of pictures.

python -m experiments.train_flow
python -m experiments.train_flow recipe=fine_tune 'data.sequences=[my_video.mp4]'
python -m experiments.train_flow recipe=raft
"""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from .errors import in_a_line, refuse_dropped_choices
from .help import answer_help
from .run_folder import keep_configuration
from .search import told
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="train_flow")
def main(config: DictConfig) -> float | None:
    from tagjax.core.settings import from_mapping
    from tagjax.training.flow_config import TrainFlowConfig
    from tagjax.training.flow_run import run_flow_training
    from tagjax.training.loop import DivergedError

    values = resolved(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    with in_a_line("train_flow", DivergedError):
        refuse_dropped_choices()
        checked = from_mapping(TrainFlowConfig, values)
        keep_configuration(folder, values)
        score = told(run_flow_training(checked, folder), folder, checked.loop.num_steps)
    print(f"run folder: {folder}")
    return score


if __name__ == "__main__":
    answer_help(__doc__, "train_flow")
    main()
