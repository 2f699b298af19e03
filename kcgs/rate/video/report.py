"""What is said of a frame that was fitted."""

from typing import NamedTuple


class FrameReport(NamedTuple):
    """A frame that was fitted."""

    number: int
    """From 0."""
    is_key: bool
    psnr: float
    """Of the frame as the clip holds it, in dB."""
    num_bytes: int
    num_gaussians: int
    born: int
    """Gaussians that are new since the frame before; all, of a key frame."""
    seconds: float
    """Processor time."""
