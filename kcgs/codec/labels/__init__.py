"""Label maps without loss; importing this loads numba."""

from .coding import decode_labels, decode_map, encode_labels, encode_map
from .following import FollowingLabels
from .moving import move_labels, still_motions
from .settling import settle_labels

__all__ = [
    "FollowingLabels",
    "decode_labels",
    "decode_map",
    "encode_labels",
    "encode_map",
    "move_labels",
    "settle_labels",
    "still_motions",
]
