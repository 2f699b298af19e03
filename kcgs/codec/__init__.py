"""The compressed file `.kcgs`, of a scene or of a label map; docs/format.md specifies it."""

from .file import MAP_MAGIC
from .gaussians.quantize import OPPONENT, QPS, Classes, Codes, Parameters, Quantizer
from .label_files import decode_labels, encode_labels
from .rangecoder import CodecError
from .region_map import encode_region_map
from .scenes import QUALITIES, Decoded, SceneWriter, decode, encode

# the public names; other packages of kcgs use the other imports
__all__ = ["CodecError", "Decoded", "decode", "decode_labels", "encode", "encode_labels"]
