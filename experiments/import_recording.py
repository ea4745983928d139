"""Import an RGB-D video, a table of tag reads, or both, as one recording.

python -m experiments.import_recording reads=table.csv                          # say what a table holds
python -m experiments.import_recording video=<TUM folder> reads=table.csv out=recordings/a.zarr
python -m experiments.import_recording video=<jpg+mat folder> calibration=cam.mat fps=7 tracks=tracks.csv out=b.zarr
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="import_recording")
def main(config: DictConfig) -> None:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.recording.importers.settings import ImportSettings, import_recording

    console = Console(soft_wrap=True, highlight=False)
    with in_a_line("import_recording"):
        _, said = import_recording(from_mapping(ImportSettings, resolved(config)))
    for line in said:
        console.print(line, markup=False)


if __name__ == "__main__":
    answer_help(__doc__, "import_recording")
    main()
