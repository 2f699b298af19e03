"""Videos as batches of scenes: read, fit, follow, edit, interpolate, write."""

from .editing import delete_region, move_region
from .files import Frames, read_label_maps, read_video, write_video
from .fitting import fit_video
from .interpolation import interpolate

__all__ = [
    "Frames", "delete_region", "fit_video", "interpolate", "move_region", "read_label_maps", "read_video",
    "write_video",
]  # fmt: skip
