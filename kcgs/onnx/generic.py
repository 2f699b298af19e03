"""The decoder of any Gaussians: a graph that takes them and the memberships of regions, and loops over tiles."""

from __future__ import annotations

import math

import numpy as np
import onnx
import torch

from kcgs._check import check_cutoff
from kcgs.kernels.whitened import support_radius

from .graph import FLOAT, Graph, Value
from .metadata import header, image_doc
from .stored import weigh

F32 = np.float32
_SIDE = 32  # of a tile, in pixels
# of the support, so that rounding drops no Gaussian that has a weight
_SLACK = 1.001


def generic_decoder(*, cutoff: float = 1e-4, clamp: bool = True) -> onnx.ModelProto:
    r"""Build the graph that renders any Gaussians, such as those that a network predicts.

    Convention: inputs ``means`` float32 :math:`(N, 2)` and ``cholesky`` float32 :math:`(N, 3)` in pixels,
    ``colors`` float32 :math:`(N, C)` with the opacities multiplied in, ``region_ids`` int64 :math:`(N)`, each a
    position among the regions, and ``memberships`` float32 :math:`(R, H, W)`: how much of each pixel is each region's,
    0 or 1 where contours are hard; without regions, ones of shape :math:`(1, H, W)` and zeros for ids. Output ``image``
    float32 :math:`(1, C, H, W)`. All sizes vary. No operator scatters. Memory is that of the image and of 1,024 weights
    for each Gaussian on a tile.

    Args:
        cutoff: weights below it are skipped, as in :func:`kcgs.functional.region_splat`.
        clamp: clip the image to [0, 1]; False: it may be below 0 and above 1.

    Returns:
        A checked model.

    Example:
        >>> import onnxruntime
        >>> from kcgs import GaussianField, RegionMap
        >>> labels = (torch.arange(48) >= 24).long().expand(32, 48)
        >>> regions = RegionMap.from_labels(labels, 0.7)
        >>> field = GaussianField.random(10, (32, 48), regions=regions, seed=0)
        >>> feeds = {name: getattr(field, name).detach().numpy() for name in ("means", "cholesky", "colors")}
        >>> feeds["region_ids"] = regions.index_of(field.region_ids).numpy()
        >>> feeds["memberships"] = torch.stack([regions.weights(i).float() for i in regions.ids.tolist()]).numpy()
        >>> session = onnxruntime.InferenceSession(generic_decoder().SerializeToString())
        >>> session.run(None, feeds)[0].shape
        (1, 3, 32, 48)
    """
    cutoff = check_cutoff(cutoff)
    g = Graph()
    means = g.input("means", F32, ["N", 2], "centres x, y in pixels of the image, from its top left corner")
    factors = "l11, l21, l22 of the Cholesky factors of the covariances, in pixels; l11, l22 > 0"
    cholesky = g.input("cholesky", F32, ["N", 3], factors)
    colors = g.input("colors", F32, ["N", "C"], "colours, 0 black to 1 white, times opacity; any sign")
    ids = g.input("region_ids", np.int64, ["N"], "region of each Gaussian, 0 to R - 1")
    memberships = g.input("memberships", F32, ["R", "H", "W"], "how much of each pixel is each region's, 0 to 1")

    size = g("Shape", memberships, start=1)
    tiles = g("Div", g("Add", size, _SIDE - 1), _SIDE)  # down, across
    padded = g("Sub", g("Mul", tiles, _SIDE), size)
    memberships = g("Pad", memberships, g("Concat", g.constant([0] * 4), padded, axis=0))
    l11, l21, l22 = g.apply("Split", [cholesky], 3, axis=1, num_outputs=3)
    spread = g("Concat", l11, g("Sqrt", g("Add", g("Mul", l21, l21), g("Mul", l22, l22))), axis=1)
    reach = g("Mul", spread, F32(support_radius(cutoff, torch.float32) * _SLACK))
    # log w is minus the sum of two squares, each of a difference times one of these
    inverses = g("Div", F32(math.sqrt(0.5)), g("Concat", l11, l22, axis=1))
    frame = g("Concat", means, inverses, g("Div", l21, l11), axis=1)  # [N, 5]

    def render_tile(g: Graph) -> list[Value]:
        number, more = g.input("tile", np.int64, []), g.input("more", np.bool_, [])
        across = g("Gather", tiles, 1)
        corner = g(
            "Mul",
            g("Concat", *(g("Reshape", g(op, number, across), g.constant([1])) for op in ("Mod", "Div")), axis=0),
            _SIDE,
        )  # x, y
        begin = g("Gather", corner, g.constant([1, 0]))
        window = g("Slice", memberships, begin, g("Add", begin, _SIDE), g.constant([1, 2]))
        window = g("Reshape", window, g.constant([0, -1]))  # [R, pixels]
        middle = g("Add", g("Cast", corner, to=FLOAT), F32(_SIDE / 2))
        distance = g("Abs", g("Sub", means, middle))
        near = g(
            "ReduceMin",
            g("Cast", g("LessOrEqual", distance, g("Add", reach, F32(_SIDE / 2))), to=FLOAT),
            g.constant([1]),
            keepdims=0,
        )
        shown = g("Gather", g("ReduceMax", window, g.constant([1]), keepdims=0), ids)
        chosen = g(
            "Compress",
            g("Range", 0, g("Squeeze", g("Shape", ids)), 1),
            g("Greater", g("Mul", near, shown), F32(0)),
            axis=0,
        )  # [K]
        part = g("Unsqueeze", g("Gather", frame, chosen), g.constant([2, 3]))
        x, y, k1, k2, slope = g.apply("Split", [part], 5, axis=1, num_outputs=5)  # [K, 1, 1, 1]
        left, top = g.split(middle, [1, 1])
        offsets = np.arange(_SIDE, dtype=F32) - F32((_SIDE - 1) / 2)
        # pixel minus mean before anything is multiplied: nothing cancels where a Gaussian is far below a pixel wide
        dx, dy = g("Add", g("Sub", left, x), offsets), g("Add", g("Sub", top, y), offsets[:, None])
        z1, z2 = g("Mul", dx, k1), g("Mul", g("Sub", dy, g("Mul", slope, dx)), k2)
        exponent = g("Neg", g("Add", g("Mul", z1, z1), g("Mul", z2, z2)))  # [K, 1, side, side]
        weight = g("Flatten", weigh(g, exponent, cutoff))
        weight = g("Mul", weight, g("Gather", window, g("Gather", ids, chosen)))
        return [g("Identity", more), g("MatMul", g("Transpose", g("Gather", colors, chosen), perm=[1, 0]), weight)]

    image = g("Loop", g("ReduceProd", tiles, keepdims=0), np.bool_(True), body=g.body(render_tile, "tiles"))
    side = g.constant([_SIDE])
    channels = g("Shape", colors, start=1)
    image = g("Reshape", image, g("Concat", tiles, channels, side, side, axis=0))
    image = g("Transpose", image, perm=[2, 0, 3, 1, 4])
    image = g("Reshape", image, g("Concat", g.constant([1]), channels, g("Mul", tiles, _SIDE), axis=0))
    image = g("Slice", image, g.constant([0, 0]), size, g.constant([2, 3]))
    if clamp:
        image = g("Clip", image, F32(0), F32(1))
    docs = "Renders any Gaussians in any regions, at the size of the memberships.", image_doc(None, clamp)
    return g.finish("image", image, F32, [1, "C", "H", "W"], header("generic", cutoff, clamp), docs)
