"""Train a tracer on unlabelled recordings and evaluate it on held-out ones.

python -m experiments.train
python -m experiments.train 'data.recordings=[a.zarr,b.zarr]' 'data.validation=[c.zarr]' loop.num_steps=200
python -m experiments.train -m optimizer.learning_rate=0.01,0.03 hydra/launcher=joblib
python -m experiments.train -m search=optuna                          # started again, a killed sweep goes on
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .errors import in_a_line, refuse_dropped_choices
from .help import answer_help
from .run_folder import keep_configuration
from .search import told, trials_left

CONFIGS = str(Path(__file__).resolve().parents[1] / "conf")


def resolved(config: DictConfig) -> dict[str, Any]:
    """Plain values: nothing of Hydra or OmegaConf enters the library."""
    values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items() if key != "num_trials"}  # which is the sweep's


OmegaConf.register_new_resolver("trials_left", trials_left, replace=True)


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="train")
def main(config: DictConfig) -> float | None:
    from tagjax.core.settings import from_mapping
    from tagjax.training.config import TrainConfig
    from tagjax.training.loop import DivergedError
    from tagjax.training.run import run_training

    values = resolved(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    with in_a_line("train", DivergedError):
        refuse_dropped_choices()
        checked = from_mapping(TrainConfig, values)
        keep_configuration(folder, values)
        score = told(run_training(checked, folder), folder, checked.loop.num_steps)
    print(f"run folder: {folder}")
    return score


if __name__ == "__main__":
    answer_help(__doc__, "train")
    main()
