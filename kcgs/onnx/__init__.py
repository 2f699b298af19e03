"""Scenes as ONNX: decoders that run wherever ONNX does.

`scene_decoder` walks one way. `plan` decides, in numpy, what is rendered where: `tiles` lists the regions of each tile,
`reach` the Gaussians that reach it, `groups` the tiles that are rendered together. `entries` stores the plan in a
`graph` and unfolds the lists of Gaussians, with `tables` and `packing`. `axis` places the pixels of the output and cuts
them into blocks. `blocks` renders these: Gaussians by `weights`, wide ones by `grids`; where a tile has several
regions, both times their `membership`, which is sampled from `windows` or `blur`. `generic` is the other decoder: one
loop over tiles, without a plan. `metadata` is what both say of themselves.
"""

from .decoder import scene_decoder
from .generic import generic_decoder
from .metadata import describe_decoder

__all__ = ["describe_decoder", "generic_decoder", "scene_decoder"]
