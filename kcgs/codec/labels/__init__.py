"""Label maps without loss; importing this loads numba."""

from .coding import decode_labels, encode_labels
from .region_map import decode_map, encode_map

__all__ = ["decode_labels", "decode_map", "encode_labels", "encode_map"]
