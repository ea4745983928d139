"""TagVision (Duan et al., INFOCOM 2017): blob tracks on a calibrated plane, matched to tags by their phases.

Imports cv2. What the paper leaves open is fixed in the parts and named there.
"""

from __future__ import annotations

from ._blobs import FLOWS, Blob, BlobSettings, backward_flow, find_blobs
from ._calibration import Board, CalibrationError, CameraCalibration, calibrate, find_corners, locate
from ._drawing import BoardSeen, draw_boards
from ._folder import (
    CalibrateSettings,
    FolderCalibration,
    PosePicture,
    calibrate_folder,
    read_picture,
    write_calibration,
    write_corners,
)
from ._match import NO_MATCH, Match, MatchSettings, match_tags
from ._plane import PlaneCamera, load_camera, save_camera
from ._score import PHASE_NOISE_RAD, Snapshots, draw_snapshots, match_scores, phase_score, residuals_rad, theory_rad
from ._snapshots import heading, hop_slope, nearest_reads, pair_interpolated, pair_nearest, unsigned_phase
from ._tracer import TagVision, TagVisionSettings, VisionState
from ._tracks import BlobTrack, Tracks, TrackSettings, colour_bins, follow

__all__ = [
    "FLOWS",
    "NO_MATCH",
    "PHASE_NOISE_RAD",
    "Blob",
    "BlobSettings",
    "BlobTrack",
    "Board",
    "BoardSeen",
    "CalibrateSettings",
    "CalibrationError",
    "CameraCalibration",
    "FolderCalibration",
    "Match",
    "MatchSettings",
    "PlaneCamera",
    "PosePicture",
    "Snapshots",
    "TagVision",
    "TagVisionSettings",
    "TrackSettings",
    "Tracks",
    "VisionState",
    "backward_flow",
    "calibrate",
    "calibrate_folder",
    "colour_bins",
    "draw_boards",
    "draw_snapshots",
    "find_blobs",
    "find_corners",
    "follow",
    "heading",
    "hop_slope",
    "load_camera",
    "locate",
    "match_scores",
    "match_tags",
    "nearest_reads",
    "pair_interpolated",
    "pair_nearest",
    "phase_score",
    "read_picture",
    "residuals_rad",
    "save_camera",
    "theory_rad",
    "unsigned_phase",
    "write_calibration",
    "write_corners",
]
