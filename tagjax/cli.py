"""The console commands `tagjax-train`, `tagjax-evaluate`, ...: the entry points of `experiments`.

An installed wheel has them as `tagjax.experiments`. In a clone, and so in an editable install, they are the top-level package
`experiments`.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable

from .core.interruption import exit_on_signals


def _command(name: str) -> Callable[[], None]:
    def run() -> None:
        exit_on_signals()  # until the command itself handles them, that is during its imports
        package = next(one for one in ("tagjax.experiments", "experiments") if importlib.util.find_spec(one))
        importlib.import_module(f"{package}.{name}").main()

    return run


benchmark = _command("benchmark")
calibrate_antenna = _command("calibrate_antenna")
calibrate_camera = _command("calibrate_camera")
calibrate_stereo = _command("calibrate_stereo")
check = _command("check")
compare = _command("compare")
error_budget = _command("error_budget")
evaluate = _command("evaluate")
evaluate_flow = _command("evaluate_flow")
fault_trial = _command("fault_trial")
gallery = _command("gallery")
goller = _command("goller")
import_recording = _command("import_recording")
picture = _command("picture")
paper = _command("paper")
reads_ceiling = _command("reads_ceiling")
record = _command("record")
report = _command("report")
reproduce = _command("reproduce")
simulate = _command("simulate")
stereo = _command("stereo")
stream = _command("stream")
sweep_paper = _command("sweep_paper")
tagview = _command("tagview")
tagvision = _command("tagvision")
tracks = _command("tracks")
train = _command("train")
train_flow = _command("train_flow")
view = _command("view")
