"""Description of the machine, for measurements."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
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


def peak_memory_mib() -> float:
    """The largest resident memory of this process so far."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux counts the memory of the process that started this one in `ru_maxrss`
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 2**10
    import resource  # not on every system

    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def resident_memory_mib() -> float:
    """The resident memory of this process now. Raises `OSError` where the system has no /proc, as Linux has."""
    try:
        pages = Path("/proc/self/statm").read_text().split()[1]
    except OSError as error:
        raise OSError(f"found no /proc/self/statm ({error}); expected Linux. Measure the memory there.") from error
    return int(pages) * os.sysconf("SC_PAGE_SIZE") / 2**20
