"""The machine that a figure was measured on."""

from __future__ import annotations

import os
import platform
from typing import Any

import jax


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    import cv2  # `import tagjax` must not pull in OpenCV

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "platform": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": round(load, 2),
        "devices": [str(device) for device in jax.devices()],
        "jax": jax.__version__,
        "opencv": cv2.__version__,
    }
