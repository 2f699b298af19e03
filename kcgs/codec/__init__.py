"""The compressed file `.kcgs`, of a scene or of a label map; docs/format.md specifies it."""

from .file import MAP_MAGIC
from .maps import decode_labels, encode_labels
from .rangecoder import CodecError
from .scenes import DEFAULT_QUALITY, QUALITIES, Decoded, decode, deserialize, encode, serialize

__all__ = [
    "DEFAULT_QUALITY", "MAP_MAGIC", "QUALITIES", "CodecError", "Decoded", "decode", "decode_labels", "deserialize",
    "encode", "encode_labels", "serialize",
]  # fmt: skip
