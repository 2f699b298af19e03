"""An image in, a file of so many bytes out."""

from .compress import Compressed, compress, fit_bytes, quality_for

__all__ = ["Compressed", "compress", "fit_bytes", "quality_for"]
