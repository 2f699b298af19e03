"""Bytes traded for error: a scene and its image in, or an image alone, and a file of so many bytes out."""

from .budget import FitBytesResult, fit_bytes
from .compress import Compressed, compress, quality_for

__all__ = ["Compressed", "FitBytesResult", "compress", "fit_bytes", "quality_for"]
