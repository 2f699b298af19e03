"""The compressed file `.kcgs`; docs/format.md specifies it."""

from .decode import Decoded, decode, deserialize
from .encode import DEFAULT_QUALITY, QUALITIES, encode, serialize
from .rangecoder import CodecError

__all__ = ["DEFAULT_QUALITY", "QUALITIES", "CodecError", "Decoded", "decode", "deserialize", "encode", "serialize"]
