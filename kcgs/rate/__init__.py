"""Rate-distortion optimized files: from a scene and its image, or from an image alone."""

from .budget import FitBytesResult, fit_bytes
from .compress import Compressed, compress, quality_for

__all__ = ["Compressed", "FitBytesResult", "compress", "fit_bytes", "quality_for"]
