"""tagjax: vision-RFID tracing in JAX."""

from .recording import (
    ClockAudit as ClockAudit,
)
from .recording import (
    Intrinsics as Intrinsics,
)
from .recording import (
    Recording as Recording,
)
from .recording import (
    RecordingError as RecordingError,
)
from .recording import (
    RecordingWarning as RecordingWarning,
)
from .recording import (
    TagReads as TagReads,
)
from .recording import (
    Truth as Truth,
)
