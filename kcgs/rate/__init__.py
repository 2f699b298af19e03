"""Rate-distortion optimized files: from a scene and its image, or from an image alone."""

from .compress import Compressed, compress, quality_for
from .fitting import FitBytesResult, fit_bytes

__all__ = ["Compressed", "FitBytesResult", "compress", "fit_bytes", "quality_for"]
