"""Train a tracer on unlabelled recordings and evaluate it on held-out ones.

python -m experiments.train
python -m experiments.train 'data.recordings=[a.zarr,b.zarr]' 'data.validation=[c.zarr]' loop.num_steps=200
python -m experiments.train -m optimizer.learning_rate=0.01,0.03 hydra/launcher=joblib
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

CONFIGS = str(Path(__file__).resolve().parents[1] / "conf")


def resolved(config: DictConfig) -> dict[str, Any]:
    """Plain values: nothing of Hydra or OmegaConf enters the library."""
    values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="train")
def main(config: DictConfig) -> float:
    from tagjax.config import TrainConfig, from_mapping
    from tagjax.training.run import run_training

    values = resolved(config)
    checked = from_mapping(TrainConfig, values)
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
    score = run_training(checked, folder)
    print(f"run folder: {folder}")
    return score


if __name__ == "__main__":
    main()
