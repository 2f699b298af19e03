"""The compressed file `.kcgs`; docs/format.md specifies it."""

from .rangecoder import CodecError
from .scenes import DEFAULT_QUALITY, QUALITIES, Decoded, decode, deserialize, encode, serialize

__all__ = ["DEFAULT_QUALITY", "QUALITIES", "CodecError", "Decoded", "decode", "deserialize", "encode", "serialize"]
