"""Any scene's decoder: one graph that takes the Gaussians and the label map as inputs.

Three loops bound the memory: over rows of tiles, over the tiles of a row, over chunks of the Gaussians that a tile
needs. A row keeps the Gaussians whose support reaches it, a tile those of its row whose support and region reach it.
"""

from __future__ import annotations

import json
import math
from typing import NamedTuple

import numpy as np
import onnx
import torch

from kcgs._check import check_count, check_cutoff
from kcgs.kernels.whitened import least_exponent, support_radius

from .graph import FLOAT, Array, Graph, Value
from .metadata import header, image_doc

_SIDE = 32  # of a tile, in pixels
_CHUNK = 64  # Gaussians evaluated at once
_OPSET = 20  # reductions of flags
MAX_WEIGHTS = _CHUNK * _SIDE * _SIDE
"""Most (Gaussian, pixel) weights that exist at a time."""

_PIXELS = _SIDE * _SIDE
_HALF = (_SIDE - 1) / 2
# z carries this factor, so that the exponent is a plain sum of two squares
_SCALE = math.sqrt(0.5)
# of the support, so that rounding drops no Gaussian that has a weight
_SLACK = 1.001


class _Scene(NamedTuple):
    """What the loops read; N Gaussians in columns."""

    colors: Value  # [C, N]
    frame: Value  # [5, N]: mean x, mean y, 1 / l11, l21 / l11, 1 / l22; the inverses times _SCALE
    tags: Value  # [2, N] int64: region id, place in colors
    reach: Value  # [1, N]: half the height of the support
    labels: Value  # [H, W] int64
    height: Value
    width: Value
    cutoff: float
    radius: float  # of the support: bound on |z|, in the unit of frame


class _Row(NamedTuple):
    """The pixels of a row of tiles and the M Gaussians whose support reaches them."""

    labels: Value  # [_SIDE, W]
    frame: Value  # [5, M]
    tags: Value  # [2, M]
    down: Value  # [1, M]: from the mean to the row's middle


class _Tile(NamedTuple):
    """The pixels of a tile and the K Gaussians that may reach them."""

    labels: Value  # [_SIDE, _SIDE]
    present: Value  # [U], the ids in labels
    single: Value  # whether U is 1
    whitened: Value  # [5, K]: z1 = (k0 + x) k1, z2 = (k2 + y) k4 + k3 x, from the tile's middle
    tags: Value  # [2, K]


def generic_decoder(*, cutoff: float = 1e-4, clamp: bool = True, channels: int | None = None) -> onnx.ModelProto:
    r"""Build the decoder of any scene that has hard contours, or none.

    Convention: inputs ``means`` float32 :math:`(N, 2)` and ``cholesky`` float32 :math:`(N, 3)` in pixels of the
    image, ``colors`` float32 :math:`(N, C)` with the opacities multiplied in, ``region_ids`` int64 :math:`(N)` and
    ``labels`` int64 :math:`(H, W)`, any non-negative ids; output ``image`` float32 :math:`(1, C, H, W)`. A scene
    without regions has zeros for ids and labels. All sizes vary; beside the image itself, memory is that of
    the Gaussians and of :data:`MAX_WEIGHTS` weights.

    Known limit: whitened in float32, a needle of anisotropy 1,000 is off by about 2e-5 of its colour.

    Args:
        cutoff: weights below it are zero, in [0, 1); 0 leaves out what is zero in float32.
        clamp: clip the image to [0, 1]; False: it may be below 0 and above 1.
        channels: C, where it is to be fixed; None: it varies too.

    Returns:
        A checked model that uses no scatter.

    Raises:
        TypeError: an argument of another type.
        ValueError: cutoff or channels out of range.

    Example:
        >>> model = generic_decoder(channels=3)
        >>> [value.name for value in model.graph.input]
        ['means', 'cholesky', 'colors', 'region_ids', 'labels']
    """
    cutoff = check_cutoff(cutoff)
    if not isinstance(clamp, bool):
        raise TypeError(f"clamp must be True or False; got {clamp!r}")
    if channels is not None:
        channels = check_count("channels", channels)
    graph = Graph(opset=_OPSET)
    depth = "C" if channels is None else channels
    scene = _declare(graph, depth, cutoff)
    image = _render(graph, scene)
    if clamp:
        image = graph("Clip", image, _floats(0), _floats(1))
    left_out = ["soft weights: contours are hard", "opacities: the caller multiplies them into the colours"]
    left_out = left_out if clamp else ["the clip to [0, 1]", *left_out]
    facts = {**header("generic", cutoff, clamp), "precision": "fp32", "left_out": json.dumps(left_out)}
    docs = "Renders any kcgs scene of hard contours: its Gaussians and its label map, at the size of the map."
    return graph.finish("image", image, np.float32, [1, depth, "H", "W"], facts, (docs, image_doc(channels, clamp)))


def _floats(values: object) -> Array:
    return np.asarray(values, dtype=np.float32)


def _declare(graph: Graph, depth: int | str, cutoff: float) -> _Scene:
    means = graph.input("means", np.float32, ["N", 2], "centres x, y in pixels of the image, from its top left corner")
    factors = "l11, l21, l22 of the Cholesky factors of the covariances, in pixels; l11, l22 > 0"
    cholesky = graph.input("cholesky", np.float32, ["N", 3], factors)
    colors = graph.input("colors", np.float32, ["N", depth], "colours, 0 black to 1 white, times opacity; any sign")
    ids = graph.input("region_ids", np.int64, ["N"], "region of each Gaussian, 0 or more; all 0 without regions")
    labels = graph.input("labels", np.int64, ["H", "W"], "region of each pixel; its size is that of the image")

    x, y = graph.apply("Split", [graph("Transpose", means, perm=[1, 0])], 2, axis=0, num_outputs=2)
    l11, l21, l22 = graph.apply("Split", [graph("Transpose", cholesky, perm=[1, 0])], 3, axis=0, num_outputs=3)
    scale = graph.constant(_floats(_SCALE))
    frame = [x, y, graph("Div", scale, l11), graph("Div", l21, l11), graph("Div", scale, l22)]
    radius = support_radius(cutoff, torch.float32) * _SLACK
    spread = graph("Sqrt", graph("Add", graph("Mul", l21, l21), graph("Mul", l22, l22)))
    place = graph("Range", 0, graph("Squeeze", graph("Shape", ids)), 1)
    tags = [graph("Unsqueeze", value, graph.constant([0])) for value in (ids, place)]
    size = graph("Shape", labels)
    return _Scene(
        colors=graph("Transpose", colors, perm=[1, 0]),
        frame=graph("Concat", *frame, axis=0),
        tags=graph("Concat", *tags, axis=0),
        reach=graph("Mul", spread, _floats(radius)),
        labels=labels,
        height=graph("Gather", size, 0),
        width=graph("Gather", size, 1),
        cutoff=cutoff,
        radius=radius * _SCALE,
    )


def _render(graph: Graph, scene: _Scene) -> Value:
    """Render all rows of tiles and put them together, (1, C, H, W)."""
    down, across = (graph("Div", graph("Add", n, _SIDE - 1), _SIDE) for n in (scene.height, scene.width))
    body = graph.body(lambda inner: _render_row(inner, scene, across), "bands")
    tiles = graph("Loop", down, graph.constant(True), body=body)  # [down, across, C, _PIXELS]

    def shape(*sizes: Value | int) -> Value:
        axis = graph.constant([0])
        parts = [graph.constant([n]) if isinstance(n, int) else graph("Unsqueeze", n, axis) for n in sizes]
        return graph("Concat", *parts, axis=0)

    channels = graph("Gather", graph("Shape", scene.colors), 0)
    image = graph("Reshape", tiles, shape(down, across, channels, _SIDE, _SIDE))
    image = graph("Transpose", image, perm=[2, 0, 3, 1, 4])
    image = graph("Reshape", image, shape(1, channels, graph("Mul", down, _SIDE), graph("Mul", across, _SIDE)))
    end = shape(scene.height, scene.width)
    return graph("Slice", image, graph.constant([0, 0]), end, graph.constant([2, 3]))


def _span(graph: Graph, number: Value, length: Value) -> tuple[Value, Value]:
    """Return the pixels of a row or column of tiles, the last one repeated past the edge, and the middle."""
    start = graph("Mul", number, _SIDE)
    pixels = graph("Add", graph.constant(np.arange(_SIDE)), start)
    middle = graph("Add", graph("Cast", start, to=FLOAT), _floats(_SIDE / 2))
    return graph("Min", pixels, graph("Sub", length, 1)), middle


def _keep(graph: Graph, keep: Value, *columns: Value) -> list[Value]:
    flat = graph("Reshape", keep, graph.constant([-1]))
    return [graph("Compress", matrix, flat, axis=1) for matrix in columns]


def _render_row(graph: Graph, scene: _Scene, across: Value) -> list[Value]:
    number, go_on = graph.input("band", np.int64, []), graph.input("band_goes_on", np.bool_, [])
    rows, middle = _span(graph, number, scene.height)
    away = graph("Sub", middle, graph("Slice", scene.frame, *map(graph.constant, ([1], [2], [0]))))
    near = graph("LessOrEqual", graph("Abs", away), graph("Add", scene.reach, _floats(_HALF)))
    frame, tags, down = _keep(graph, near, scene.frame, scene.tags, away)
    row = _Row(graph("Gather", scene.labels, rows, axis=0), frame, tags, down)
    body = graph.body(lambda inner: _render_tile(inner, scene, row), "tiles")
    return [graph("Identity", go_on), graph("Loop", across, graph.constant(True), body=body)]


def _render_tile(graph: Graph, scene: _Scene, row: _Row) -> list[Value]:
    number, go_on = graph.input("tile", np.int64, []), graph.input("tile_goes_on", np.bool_, [])
    columns, middle = _span(graph, number, scene.width)
    tile = _enter_tile(graph, scene, row, graph("Gather", row.labels, columns, axis=1), middle)
    count = graph("Gather", graph("Shape", tile.tags), 1)
    chunks = graph("Div", graph("Add", count, _CHUNK - 1), _CHUNK)
    channels = graph("Shape", scene.colors, start=0, end=1)
    black = graph("Expand", _floats(0), graph("Concat", channels, graph.constant([_PIXELS]), axis=0))
    body = graph.body(lambda inner: _add_chunk(inner, scene, tile), "chunks")
    return [graph("Identity", go_on), graph("Loop", chunks, graph.constant(True), black, body=body)]


def _enter_tile(graph: Graph, scene: _Scene, row: _Row, labels: Value, middle: Value) -> _Tile:
    """Whiten from the tile's middle and keep the Gaussians that may reach the tile."""
    x, _, inverse1, slope, inverse2 = graph.apply("Split", [row.frame], 5, axis=0, num_outputs=5)
    across = graph("Sub", middle, x)
    down = graph("Sub", row.down, graph("Mul", slope, across))
    shear = graph("Neg", graph("Mul", slope, inverse2))
    # how far z goes from the middle to the pixel that is farthest
    spread1 = graph("Mul", inverse1, _floats(_HALF))
    spread2 = graph("Mul", graph("Add", graph("Abs", shear), inverse2), _floats(_HALF))
    z1, z2 = graph("Mul", across, inverse1), graph("Mul", down, inverse2)
    near = [
        graph("LessOrEqual", graph("Abs", z), graph("Add", spread, _floats(scene.radius)))
        for z, spread in ((z1, spread1), (z2, spread2))
    ]
    ids = graph("Slice", row.tags, *map(graph.constant, ([0], [1], [0])))
    present = graph("Unique", labels, sorted=1)
    # the ends of a sorted list: onnxruntime's ReduceMin and ReduceMax err on int64 beyond 32 bits
    low, high = (graph("Gather", present, end) for end in (0, -1))
    # exact where the tile has one region; else the ids between are left to the chunks, whose memory is bounded
    known = graph("And", graph("LessOrEqual", low, ids), graph("LessOrEqual", ids, high))
    keep = graph("And", graph("And", *near), known)
    whitened = graph("Concat", across, inverse1, down, shear, inverse2, axis=0)
    return _Tile(labels, present, graph("Equal", low, high), *_keep(graph, keep, whitened, row.tags))


def _add_chunk(graph: Graph, scene: _Scene, tile: _Tile) -> list[Value]:
    number, go_on = graph.input("chunk", np.int64, []), graph.input("chunk_goes_on", np.bool_, [])
    total = graph.input("picture", np.float32, ["channels", _PIXELS])
    start = graph("Unsqueeze", graph("Mul", number, _CHUNK), graph.constant([0]))
    end = graph("Add", start, _CHUNK)
    whitened, tags = (graph("Slice", matrix, start, end, graph.constant([1])) for matrix in (tile.whitened, tile.tags))

    def one_region(inner: Graph) -> list[Value]:
        return [_evaluate(inner, scene, whitened, tags, None)]

    def several_regions(inner: Graph) -> list[Value]:
        ids = inner("Gather", tags, 0, axis=0)
        same = inner("Equal", inner("Unsqueeze", ids, inner.constant([1])), tile.present)  # [K, U]
        kept, places = _keep(inner, inner("ReduceMax", same, inner.constant([1])), whitened, tags)
        return [_evaluate(inner, scene, kept, places, tile.labels)]

    branches = {
        "then_branch": graph.body(one_region, "one_region"),
        "else_branch": graph.body(several_regions, "several_regions"),
    }
    return [graph("Identity", go_on), graph("Add", total, graph("If", tile.single, **branches))]


def _evaluate(graph: Graph, scene: _Scene, whitened: Value, tags: Value, labels: Value | None) -> Value:
    """Sum colour times weight over K Gaussians, [C, _PIXELS]; labels: only where they equal the Gaussian's id."""
    offsets = np.arange(_SIDE) - _HALF
    x, y = _floats(offsets), _floats(offsets[:, None])
    columns = graph("Unsqueeze", whitened, graph.constant([2, 3]))  # [5, K, 1, 1]
    k0, k1, k2, k3, k4 = graph.apply("Split", [columns], 5, axis=0, num_outputs=5)
    # pixel minus mean before anything is multiplied: nothing cancels where a Gaussian is far below a pixel wide
    z1 = graph("Mul", graph("Add", k0, x), k1)  # [1, K, 1, _SIDE]
    z2 = graph("Add", graph("Mul", graph("Add", k2, y), k4), graph("Mul", k3, x))  # [1, K, _SIDE, _SIDE]
    exponent = graph("Sub", graph("Neg", graph("Mul", z1, z1)), graph("Mul", z2, z2))
    weight = graph("Exp", graph("Max", exponent, _floats(least_exponent(0.0, torch.float32))))
    kept = graph("GreaterOrEqual", weight, _floats(scene.cutoff)) if scene.cutoff > 0.0 else None
    ids, place = graph.apply("Split", [tags], 2, axis=0, num_outputs=2)
    if labels is not None:
        same = graph("Equal", graph("Unsqueeze", ids, graph.constant([2, 3])), labels)
        kept = same if kept is None else graph("And", kept, same)
    if kept is not None:
        weight = graph("Where", kept, weight, _floats(0))
    colors = graph("Gather", scene.colors, graph("Squeeze", place, graph.constant([0])), axis=1)
    return graph("MatMul", colors, graph("Flatten", weight, axis=2))
