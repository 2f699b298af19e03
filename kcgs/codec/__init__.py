"""The compressed file `.kcgs`."""

from .errors import CodecError
from .scene import DEFAULT_QUALITY, QUALITIES, Decoded, decode, deserialize, encode, serialize

__all__ = ["DEFAULT_QUALITY", "QUALITIES", "CodecError", "Decoded", "decode", "deserialize", "encode", "serialize"]
