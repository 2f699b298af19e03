"""The decoder of any Gaussians: its inputs are Gaussians and memberships of regions, and it loops over tiles."""

from __future__ import annotations

import numpy as np
import onnx
import torch

from kcgs._check import check_cutoff
from kcgs.kernels import least_whitened, support_radius, whiten

from .graph import FLOAT, INT64, Graph, Value
from .metadata import decoder_metadata, image_doc
from .weights import ROOT, weigh

# side of a tile in pixels: smaller tiles need more turns of the loop, larger tiles evaluate more Gaussians at pixels
# that they do not reach
_SIDE = 32


def generic_decoder(*, cutoff: float = 1e-4, clamp: bool = True) -> onnx.ModelProto:
    r"""Build the graph that renders any Gaussians, for example the prediction of a network.

    Convention: the inputs are

    - ``means``, float32 :math:`(N, 2)`, and ``cholesky``, float32 :math:`(N, 3)`, in pixels;
    - ``colors``, float32 :math:`(N, C)`, multiplied by the opacities;
    - ``region_ids``, int64 :math:`(N)`: indices from 0 to R - 1, or -1 for a Gaussian that paints nothing;
    - ``memberships``, float32 :math:`(R, H, W)`: the share of each region in each pixel, 0 or 1 for hard contours.

    Without regions, pass ones of shape :math:`(1, H, W)`, and zeros as ids. The output is ``image``, float32
    :math:`(1, C, H, W)`. All sizes vary. No operator scatters. Memory holds the image, and 1,024 weights for each
    Gaussian on a tile.

    Args:
        cutoff: weights below it are skipped, as in :func:`kcgs.functional.region_splat`.
        clamp: clip the image to [0, 1]; False: it may be below 0 and above 1.

    Returns:
        A checked model.

    Example:
        >>> import onnxruntime
        >>> from kcgs import GaussianField, RegionMap
        >>> labels = (torch.arange(48) >= 24).long().expand(32, 48)
        >>> regions = RegionMap(labels, 0.7)
        >>> field = GaussianField.random(10, (32, 48), regions=regions, seed=0)
        >>> feeds = {name: getattr(field, name).detach().numpy() for name in ("means", "cholesky", "colors")}
        >>> feeds["region_ids"] = regions.index_of(field.region_ids).numpy()
        >>> feeds["memberships"] = torch.stack([regions.membership(i).float() for i in regions.ids.tolist()]).numpy()
        >>> session = onnxruntime.InferenceSession(generic_decoder().SerializeToString())
        >>> session.run(None, feeds)[0].shape
        (1, 3, 32, 48)
    """
    cutoff = check_cutoff(cutoff)
    g = Graph()
    means = g.input("means", FLOAT, ["N", 2], "centres x, y in pixels of the image, from its top left corner")
    factors = "l11, l21, l22 of the Cholesky factors of the covariances, in pixels; l11, l22 > 0"
    cholesky = g.input("cholesky", FLOAT, ["N", 3], factors)
    colors = g.input("colors", FLOAT, ["N", "C"], "colours, 0 black to 1 white, times opacity; any sign")
    ids = g.input("region_ids", INT64, ["N"], "region of each Gaussian, 0 to R - 1; -1: none")
    memberships = g.input("memberships", FLOAT, ["R", "H", "W"], "how much of each pixel is each region's, 0 to 1")

    size = g.Shape(memberships, start=1)
    tiles = (size + (_SIDE - 1)) // _SIDE  # down, across
    # the last region, which the id -1 reads, has no pixels
    memberships = g.Pad(memberships, g.Concat([0, 0, 0, 1], tiles * _SIDE - size, axis=0))
    l11, l21, l22 = g.split(cholesky, 3, axis=1)
    parameters = g.Concat(means, ROOT / l11, l21 / l11, ROOT / l22, axis=1)  # [N, 5]
    columns = g.split(g.Transpose(parameters, perm=[1, 0]), 5)  # [1, N]
    numbers, across = g.Range(0, g.Squeeze(g.Shape(ids)), 1), g.Gather(tiles, 1)
    radius = support_radius(cutoff, torch.float32) * ROOT

    def render_tile(number: Value) -> Value:
        corner = g.Concat(g.Reshape(number % across, [1]), g.Reshape(number // across, [1]), axis=0) * _SIDE  # x, y
        begin = corner[g.constant([1, 0])]
        window = g.Slice(memberships, begin, begin + _SIDE, [1, 2])
        window = g.Reshape(window, [0, -1])  # [R + 1, pixels]
        middle_x, middle_y = g.split(corner.astype(FLOAT) + _SIDE / 2, 2)
        x, y, k1, slope, k2 = columns
        z1, z2 = least_whitened(middle_x - x, middle_y - y, k1, slope, k2, _SIDE / 2)
        share = g.ReduceMax(window, [1], keepdims=0)[ids]
        near = g.And(g.LessOrEqual(g.Max(z1, z2), radius), g.Greater(share, 0.0))
        gaussian = g.Compress(numbers, g.Squeeze(near, [0]), axis=0)  # [K]
        weight = _weights_of_tile(g, parameters[gaussian], middle_x, middle_y, cutoff) * window[ids[gaussian]]
        return g.Transpose(colors[gaussian], perm=[1, 0]) @ weight

    image = _join(g, g.loop(g.ReduceProd(tiles, keepdims=0), render_tile), colors, tiles)
    image = g.Slice(image, [0, 0], size, [2, 3])
    if clamp:
        image = g.Clip(image, 0.0, 1.0)
    return g.close(
        image,
        "image",
        [1, "C", "H", "W"],
        image_doc(None, clamp),
        graph_doc="Renders any Gaussians in any regions, at the size of the memberships.",
        metadata=decoder_metadata("generic", cutoff, clamp),
    )


def _weights_of_tile(g: Graph, parameters: Value, middle_x: Value, middle_y: Value, cutoff: float) -> Value:
    """Return the weights, (K, pixels), of Gaussians, `parameters` (K, 5), at the pixels of a tile."""
    x, y, k1, slope, k2 = g.split(g.Unsqueeze(parameters, [2, 3]), 5, axis=1)  # [K, 1, 1, 1]
    offsets = np.arange(_SIDE, dtype=np.float32) - np.float32((_SIDE - 1) / 2)
    # subtract the mean before all products: so Gaussians far thinner than a pixel have no cancellation
    dx, dy = (middle_x - x) + offsets, (middle_y - y) + offsets[:, None]
    z1, z2 = whiten(dx, dy, k1, slope, k2)
    return g.Flatten(weigh(g, -(z1 * z1 + z2 * z2), cutoff))


def _join(g: Graph, rendered: Value, colors: Value, tiles: Value) -> Value:
    """Join rendered tiles, (T, C, pixels), to an image of `tiles` down and across, (1, C, H, W)."""
    side = g.constant([_SIDE])
    channels = g.Shape(colors, start=1)
    image = g.Reshape(rendered, g.Concat(tiles, channels, side, side, axis=0))
    image = g.Transpose(image, perm=[2, 0, 3, 1, 4])
    return g.Reshape(image, g.Concat(g.constant([1]), channels, tiles * _SIDE, axis=0))
