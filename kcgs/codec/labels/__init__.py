"""Label maps without loss; importing this loads numba."""

from .coding import decode_labels, decode_map, encode_labels, encode_map

__all__ = ["decode_labels", "decode_map", "encode_labels", "encode_map"]
