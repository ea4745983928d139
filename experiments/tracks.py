"""Which of several real tracks carries a tag, virtual or real: accuracy of every method's association score by window length.

python -m experiments.tracks folder=<folder with kinect-rfid/ and xovis-uwb/>
python -m experiments.tracks folder=<...> 'windows_s=[2,4]' most=10 noise_m=0.05

Of kinect-rfid/ the files <date>.txt (skeletons) and RFID_<date>.txt (the reader's speeds) are read, of xovis-uwb/ the files
raw_xovis.csv (stereo tracks) and XOVIS_UWB.csv (a UWB tag's positions and whose it is); either folder will do. One tag is put on each track,
and the real tags' own are asked as well: tables.md, real_tags.png and metrics.json in the run folder.
"""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="tracks")
def main(config: DictConfig) -> None:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.tracks import TracksConfig, run_tracks

    values = resolved(config)
    if values.get("folder") is None:
        raise SystemExit("tracks: name a folder with kinect-rfid/ or xovis-uwb/: folder=<...>.")
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
    console = Console()
    with in_a_line("tracks"), console.status("scoring", spinner="line") as status:
        run_tracks(from_mapping(TracksConfig, values), folder, on_done=status.update)
    console.print((folder / "tables.md").read_text(), markup=False)
    console.print(f"run folder: {folder}")


if __name__ == "__main__":
    answer_help(__doc__, "tracks")
    main()
