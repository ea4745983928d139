"""Settings of a recording, and the camera, the reader and the emulator that they name."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from ...core.settings import ConfigError
from ..recording import Recording
from ..store import open_recording
from .camera import AbstractCamera, CameraSettings, PlaybackCamera
from .emulation import LOOPBACK, AbstractEmulator, EmulatorSettings, PlaybackStart
from .llrp import LLRP_PORT, LlrpReader
from .playback_reader import PlaybackReader
from .r700 import PASSWORD, USER, R700Reader, TlsSettings
from .reader import AbstractReader, ConnectionSettings, InventorySettings

CameraKind: TypeAlias = Literal["playback", "realsense", "orbbec", "k4a"]
ReaderKind: TypeAlias = Literal["llrp", "r700", "playback"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """How camera and reader are reached and set."""

    recording: str | None = None  # that is played
    address: str | None = None  # of the reader: <host> or <host>:<port>; https://<host> of an R700
    emulate: bool = False  # the reader is an emulated one on loopback, with the reads of `recording`
    antennas_m: tuple[tuple[float, float, float], ...] | None = None  # None: those of `recording`
    camera_settings: CameraSettings = dataclasses.field(default_factory=CameraSettings)
    inventory: InventorySettings = dataclasses.field(default_factory=InventorySettings)
    connection: ConnectionSettings = dataclasses.field(default_factory=ConnectionSettings)
    tls: TlsSettings = dataclasses.field(default_factory=TlsSettings)
    emulator: EmulatorSettings = dataclasses.field(default_factory=EmulatorSettings)

    def __post_init__(self) -> None:
        if self.address is not None and "@" in self.address:
            raise ConfigError(
                "address: found a user or password in it; expected none, because run folder and recording keep the address. Set the "
                f"environment variables {USER} and {PASSWORD}."
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorConfig(SensorSettings):
    """Which sensors are used. Raises `ConfigError` for settings that do not fit together."""

    camera: CameraKind = "playback"
    reader: ReaderKind = "playback"

    def __post_init__(self) -> None:
        super().__post_init__()
        if ("playback" in (self.camera, self.reader) or self.emulate) and self.recording is None:
            raise ConfigError("recording is null; expected the recording that is played. Give recording=<a recording>.")
        if self.reader != "playback" and (self.address is None) != self.emulate:
            raise ConfigError(
                f"reader is {self.reader}, address is {self.address}, emulate is {self.emulate}; expected either the reader's "
                "address, or emulate=true."
            )
        if self.emulate and self.reader == "playback":
            raise ConfigError(
                "reader is playback, which needs no emulator; expected emulate=false, or reader=llrp or r700."
            )
        if self.antennas_m is None and self.recording is None:
            raise ConfigError("antennas_m is null; expected the antennas' positions in the camera frame, in metres.")
        if self.antennas_m is not None and self.reader != "playback" and not self.emulate:
            self._check_ports(len(self.antennas_m))

    def _check_ports(self, num_antennas: int) -> None:
        highest = max(self.inventory.antennas)
        if highest > num_antennas:
            raise ConfigError(
                f"inventory.antennas names port {highest}, antennas_m has {num_antennas} positions; expected one for every port."
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordConfig(SensorConfig):
    """Which sensors are recorded, and where to. Raises `ConfigError` for settings that do not fit together."""

    out: str | None = None
    finish: str | None = None  # a recording that was cut off
    name: str | None = None  # None: that of `out`
    duration_s: float | None = None
    commit_s: float = 0.5
    preview: bool = True

    def __post_init__(self) -> None:
        if (self.out is None) == (self.finish is None):
            raise ConfigError("found neither out nor finish, or both; expected out=<a new folder>.zarr.")
        if self.commit_s <= 0 or (self.duration_s is not None and self.duration_s <= 0):
            raise ConfigError(f"commit_s is {self.commit_s}, duration_s {self.duration_s}; expected positive seconds.")
        if self.finish is None:
            super().__post_init__()


@dataclasses.dataclass(frozen=True)
class Sensors:
    """The sensors of a recording. The emulator, where there is one, listens before `reader` is made."""

    camera: AbstractCamera
    antennas_m: np.ndarray  # (num_antennas, 3)
    start: PlaybackStart
    played: Recording | None
    source: str
    emulator: AbstractEmulator | None


def make_sensors(config: SensorConfig) -> Sensors:
    """Camera and emulator. Raises `RecordingError` for a recording that cannot be played."""
    played, start = None if config.recording is None else open_recording(config.recording), PlaybackStart()
    if config.antennas_m is not None:
        antennas_m = np.array(config.antennas_m, np.float64)
    else:
        assert played is not None  # SensorConfig has checked it
        antennas_m = np.asarray(played.antennas_m, np.float64)
    if config.camera == "playback":
        assert played is not None
        camera: AbstractCamera = PlaybackCamera(played, start)
    else:
        from . import hardware_cameras as hardware

        cameras = {
            "realsense": hardware.RealSenseCamera,
            "orbbec": hardware.OrbbecCamera,
            "k4a": hardware.AzureKinectCamera,
        }
        camera = cameras[config.camera](config.camera_settings)
    emulator = None
    if config.emulate:
        assert played is not None
        emulator = _emulator(config, played, start)
    source = f"recorded: camera {config.camera}, reader {config.reader}{' (emulated)' if config.emulate else ''}"
    if played is not None:
        source = f"{source}; of {Path(config.recording or '').name}"
    return Sensors(camera, antennas_m, start, played, source, emulator)


def _emulator(config: SensorConfig, played: Recording, start: PlaybackStart) -> AbstractEmulator:
    origin_ns = int(played.time_ns[0])
    if config.reader == "llrp":
        from .llrp_emulator import LlrpEmulator

        return LlrpEmulator(played.reads, origin_ns, start=start, settings=config.emulator)
    from .r700_emulator import R700Emulator

    return R700Emulator(played.reads, origin_ns, start=start, settings=config.emulator)


def make_reader(config: SensorConfig, sensors: Sensors) -> AbstractReader:
    """The reader. Raises `ReaderError` for an address or a package that is missing."""
    if config.reader == "playback":
        assert sensors.played is not None
        played = sensors.played
        return PlaybackReader(played.reads, int(played.time_ns[0]), sensors.start, config.emulator)
    inventory, connection = config.inventory, config.connection
    if sensors.emulator is not None:  # it has the recording's antennas
        inventory = dataclasses.replace(inventory, antennas=tuple(range(1, len(sensors.antennas_m) + 1)))
        host, port = LOOPBACK, sensors.emulator.port
    else:
        host, port = _host_and_port(config.address or "")
    if config.reader == "llrp":
        return LlrpReader(host, port, inventory=inventory, connection=connection)
    address = f"http://{host}:{port}" if sensors.emulator is not None else config.address or ""
    return R700Reader(address, inventory=inventory, connection=connection, tls=config.tls)


def _host_and_port(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if colon and port.isascii() and port.isdigit() and ":" not in host:
        return host, int(port)
    return address, LLRP_PORT
