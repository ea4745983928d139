"""Description of the machine, for measurements."""

from __future__ import annotations

import os
import platform
from typing import Any

import jax


def machine() -> dict[str, Any]:
    """Platform, processor, cores, load, devices and versions of JAX and OpenCV."""
    import cv2  # `import tagjax` must not import OpenCV

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
