"""Scenes as ONNX: decoders that run wherever ONNX does."""

from .decoder import scene_decoder
from .generic import generic_decoder
from .metadata import describe_decoder

__all__ = ["describe_decoder", "generic_decoder", "scene_decoder"]
