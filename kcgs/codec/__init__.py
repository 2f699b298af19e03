"""The compressed file `.kcgs`, of a scene or of a label map; docs/format.md specifies it."""

from .label_files import decode_labels, encode_labels
from .rangecoder import CodecError
from .scenes import Decoded, decode, encode

__all__ = ["CodecError", "Decoded", "decode", "decode_labels", "encode", "encode_labels"]
