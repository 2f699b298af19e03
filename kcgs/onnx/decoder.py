"""From a scene to its decoder: what is asked for, what is left out, what the file says of itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
import torch

from kcgs._check import check_cutoff
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .axis import Axis
from .drawing import Drawing
from .graph import INT64, Graph, Value
from .groups import Baked, Group, bake, group_tiles
from .lists import Tiles, find_tiles, list_gaussians
from .metadata import describe
from .shares import Windows
from .stored import Stored

PRECISIONS = ("fp32", "fp16")
# change of a value of the picture that float16 may make
_LARGEST_CHANGE = 1 / 255


def scene_decoder(
    field: GaussianField,
    regions: RegionMap | torch.Tensor | None = None,
    *,
    cutoff: float = 1e-4,
    clamp: bool = False,
    precision: str = "fp32",
    interactive: bool = False,
    recipe: str = "",
) -> onnx.ModelProto:
    r"""Build the ONNX graph that draws one scene at any size.

    Input ``size``, int64 (2,): height and width of the picture. Output ``image``, float32 :math:`(1, C, H, W)`: what
    :class:`kcgs.nn.RegionSplatRenderer` draws at that size. No operator scatters, so that it runs on WebGPU. Memory
    and time are those of the pixels times the Gaussians on each: for parts of very large pictures there is ``view``.

    Args:
        field: unbatched.
        regions: one label map of the field's size, or None.
        cutoff: weights below it are skipped, as in :func:`kcgs.functional.region_splat`.
        clamp: clip the picture to [0, 1].
        precision: "fp32"; or "fp16": Cholesky factors and colours are stored in 16 bits, and computed with in 32.
        interactive: two more inputs. ``view``, float32 (4,): left, top, right and bottom of the part of the scene that
            fills the picture, in pixels of the scene. ``visible``, float32 (R,): a factor on the Gaussians of each
            region, in the order of the map's ids.
        recipe: noted in the file.

    Returns:
        A checked model; its metadata say what it is and what was left out: see :func:`describe_decoder`.

    Raises:
        TypeError: wrong types.
        ValueError: a batch, regions of another size or without region ids, a number out of range; "fp16" where it
            changes a value of the picture, at its own size or twice that, by 1/255 or more.

    Example:
        >>> import numpy as np, onnxruntime
        >>> model = scene_decoder(GaussianField.random(10, (32, 48), seed=0))
        >>> session = onnxruntime.InferenceSession(model.SerializeToString())
        >>> session.run(None, {"size": np.array([64, 96])})[0].shape
        (1, 3, 64, 96)
    """
    regions = _check(field, regions, precision)
    cutoff = check_cutoff(cutoff)
    tiles = find_tiles(regions, field.size)
    entries = list_gaussians(field, regions, tiles, cutoff)
    baked, entries = bake(field, regions, entries)
    groups = group_tiles(entries, tiles, baked, cutoff)
    facts = describe(field, regions, tiles, groups, entries, recipe=recipe, cutoff=cutoff, clamp=clamp)
    plan = _Plan(field, regions, tiles, baked, groups, cutoff, clamp, interactive)
    exact = plan.build("fp32", facts)
    if precision == "fp32":
        return exact
    half = plan.build("fp16", facts)
    _check_change(exact, half, field.size, baked, interactive, 1 if regions is None else regions.num_regions)
    return half


class _Plan:
    """What a graph is built of."""

    def __init__(
        self,
        field: GaussianField,
        regions: RegionMap | None,
        tiles: Tiles,
        baked: Baked,
        groups: Sequence[Group],
        cutoff: float,
        clamp: bool,
        interactive: bool,
    ) -> None:
        self.size, self.regions, self.tiles, self.baked = field.size, regions, tiles, baked
        self.groups, self.cutoff, self.clamp, self.interactive = groups, cutoff, clamp, interactive

    def build(self, precision: str, facts: Mapping[str, str]) -> onnx.ModelProto:
        """Build the graph."""
        g = Graph()
        down, across, visible = self._inputs(g)
        stored = Stored(g, self.baked, self.groups, self.tiles, visible, half=precision == "fp16")
        drawing = Drawing(g, stored, down, across, self.cutoff)
        picture = _assemble(g, self._blocks(g, drawing), down, across, drawing.channels)
        if self.clamp:
            picture = g("Clip", picture, np.float32(0), np.float32(1))
        shape: list[int | str] = [1, drawing.channels, "height", "width"]
        return g.finish({"image": picture}, np.float32, [shape], {**facts, "precision": precision})

    def _inputs(self, g: Graph) -> tuple[Axis, Axis, Value | None]:
        size = g.input("size", np.int64, [2])
        rows, cols = g.apply("Split", [size], 2, axis=0, num_outputs=2)
        if not self.interactive:
            return Axis(g, rows, self.size[0]), Axis(g, cols, self.size[1]), None
        view = g.input("view", np.float32, [4])
        left, top, right, bottom = g.apply("Split", [view], 4, axis=0, num_outputs=4)
        visible = g.input("visible", np.float32, [1 if self.regions is None else self.regions.num_regions])
        return Axis(g, rows, self.size[0], (top, bottom)), Axis(g, cols, self.size[1], (left, right)), visible

    def _blocks(self, g: Graph, drawing: Drawing) -> Value:
        """Draw all blocks in raster order, (NB, C, P)."""
        down, across, tiles = drawing.down, drawing.across, self.tiles
        windows = None
        if self.regions is not None and any(group.regions > 1 for group in self.groups):
            soft = self.regions.softness != 0.0
            windows = Windows(g, tiles, down, across, 1 if soft else self.regions.supersample, soft)
        group_of = np.full(tiles.rows * tiles.cols, len(self.groups))
        slot_of = np.zeros(tiles.rows * tiles.cols, np.int64)
        for number, group in enumerate(self.groups):
            group_of[group.tiles], slot_of[group.tiles] = number, np.arange(len(group.tiles))
        one = g.constant([1])
        tile = g("Add", g("Unsqueeze", g("Mul", down.tile, tiles.cols), one), across.tile)
        tile = g("Reshape", tile, g.constant([-1]))
        own = g("Cast", g("Gather", g.whole(group_of), tile), to=INT64)
        slots = g("Cast", g("Gather", g.whole(slot_of), tile), to=INT64)
        order, starts, stops, index = self._sort(g, own)
        drawn = []
        for number, group in enumerate(self.groups):
            start, stop = (g("Gather", at, g.constant([number])) for at in (starts, stops))
            chosen = g("Slice", order, start, stop, g.constant([0]))
            place = g("Min", g("Gather", slots, chosen), len(group.tiles) - 1)
            drawn.append(drawing.group(number, chosen, place, windows))
        # one black block for all that nothing touches
        black = g("Concat", g.constant([1, drawing.channels]), drawing.pixels, axis=0)
        drawn.append(g("Expand", np.float32(0), black))
        return g("Gather", g("Concat", *drawn, axis=0), index)

    def _sort(self, g: Graph, own: Value) -> tuple[Value, Value, Value, Value]:
        """Sort blocks by their group.

        A group without a block draws one that nobody looks at: tensors without elements are not for every runtime.

        Args:
            g: the graph.
            own: group of each block, (NB,); the number of groups for those that nothing touches.

        Returns:
            The sorted blocks, with one to spare; where each group's begin and end; where each block is drawn.
        """
        count = len(self.groups)
        total = g("Shape", own)
        key = g("Add", g("Mul", own, total), g("Range", np.int64(0), g("Squeeze", total), np.int64(1)))
        order = g.apply("TopK", [key, total], 2, largest=0, axis=0)[1]
        rank = g.apply("TopK", [order, total], 2, largest=0, axis=0)[1]
        mine = g("Cast", g("Equal", g.constant(np.arange(count + 1)[:, None]), own), to=INT64)
        counts = g("ReduceSum", mine, g.constant([1]), keepdims=0)
        drawn = g("Max", counts, np.array([1] * count + [0]))
        starts, firsts = (g("CumSum", n, np.int64(0), exclusive=1) for n in (counts, drawn))
        index = g("Add", rank, g("Gather", g("Sub", firsts, starts), own))
        black = g("Gather", firsts, g.constant([count]))
        index = g("Min", index, black)
        return g("Concat", order, g.constant([0]), axis=0), starts, g("Add", starts, drawn), index


def _assemble(g: Graph, blocks: Value, down: Axis, across: Axis, channels: int) -> Value:
    """Put the blocks together and leave out the pixels to spare: columns, then rows, each a stretch of memory."""
    split = g("Concat", down.blocks, across.blocks, g.constant([channels]), across.side, down.side, axis=0)
    picture = g("Transpose", g("Reshape", blocks, split), perm=[1, 3, 2, 0, 4])
    width, height = (g("Mul", axis.blocks, axis.side) for axis in (across, down))
    picture = g("Reshape", picture, g("Concat", width, g.constant([1, channels]), height, axis=0))
    picture = g("Transpose", g("Gather", picture, across.place, axis=0), perm=[1, 2, 3, 0])
    return g("Gather", picture, down.place, axis=2)


def _check(field: object, regions: object, precision: str) -> RegionMap | None:
    if not isinstance(field, GaussianField):
        raise TypeError(f"field must be a GaussianField; got {type(field).__name__}")
    if field.means.ndim != 2:
        raise ValueError(f"field must be unbatched; got means of shape {tuple(field.means.shape)}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}; got {precision!r}")
    if regions is None:
        return None
    if isinstance(regions, torch.Tensor):
        regions = RegionMap.from_labels(regions)
    if not isinstance(regions, RegionMap):
        raise TypeError(f"regions must be a RegionMap, a label map Tensor or None; got {type(regions).__name__}")
    if regions.labels.ndim != 2 or regions.size != field.size:
        raise ValueError(
            f"regions must be one map of the field's size {field.size}; got labels of shape "
            f"{tuple(regions.labels.shape)}"
        )
    if regions.resized:
        raise ValueError("regions must be the map itself; got a soft one that was resized")
    if field.region_ids is None:
        raise ValueError("field must have region_ids where regions are given; call field.assign_regions(regions)")
    return regions


def _check_change(
    exact: onnx.ModelProto, half: onnx.ModelProto, size: tuple[int, int], baked: Baked, interactive: bool, regions: int
) -> None:
    import onnxruntime

    feeds: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {}
    if interactive:
        feeds = {"view": np.array([0, 0, size[1], size[0]], np.float32), "visible": np.ones(regions, np.float32)}
    sessions = [onnxruntime.InferenceSession(m.SerializeToString()) for m in (exact, half)]
    for factor in (1, 2):
        feeds["size"] = factor * np.array(size)
        pictures = [session.run(None, feeds)[0] for session in sessions]
        change = float(np.abs(pictures[0] - pictures[1]).max())
        if not change < _LARGEST_CHANGE:
            raise ValueError(
                f"precision must be fp32 for this scene: fp16 changes a value of the picture by {change:.2g}, which is "
                f"not below 1/255 = {_LARGEST_CHANGE:.2g}"
            )
