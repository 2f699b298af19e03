"""ONNX decoders: graphs that render scenes in any ONNX runtime.

All are written in the small language of `graph`.

`scene_decoder` calls the modules in this order. `plan` lists, in numpy, the Gaussians of every tile: `tiles` finds the
regions of a tile, `reach` the Gaussians that reach it, `groups` the tiles that are rendered together. `entries` stores
the plan in the graph and unfolds the lists of Gaussians; it uses `tables` and `packing`. `axis` places the pixels of
the output and cuts them into blocks. `blocks` renders the blocks: Gaussians by `weights`, wide Gaussians by `grids`. In
a tile with several regions it multiplies both by `membership`, which is sampled from `windows` or `blur`. `generic` is
the other decoder: one loop over tiles, without a plan. `metadata` describes both decoders.
"""

from .decoder import scene_decoder
from .generic import generic_decoder
from .metadata import describe_decoder

__all__ = ["describe_decoder", "generic_decoder", "scene_decoder"]
