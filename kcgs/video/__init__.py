"""Videos as batches of scenes: read, fit, edit, interpolate and write them."""

from .editing import delete_from_video, move_in_video
from .files import DEFAULT_FRAME_RATE, Frames, read_label_maps, read_video, write_video
from .fitting import fit_video
from .interpolation import interpolate

# the public names; other packages of kcgs use the other imports
__all__ = [
    "Frames", "delete_from_video", "fit_video", "interpolate", "move_in_video", "read_label_maps", "read_video",
    "write_video",
]  # fmt: skip
