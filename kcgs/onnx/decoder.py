"""From a scene to its decoder: what is asked for, what is checked, how the graph is put together."""

from __future__ import annotations

import numpy as np
import onnx

from kcgs._check import check_cutoff
from kcgs.functional import RegionMap
from kcgs.functional.softness import check_contours
from kcgs.scene import Scene, check_scene

from .axis import Axis
from .blocks import Blocks
from .graph import Graph, Value
from .layout import lay_out
from .metadata import describe, image_doc
from .planes import Planes
from .stored import Stored
from .windows import Windows


def scene_decoder(
    scene: Scene,
    *,
    cutoff: float = 1e-4,
    clamp: bool = True,
    interactive: bool = False,
    contours: str = "scaled",
) -> onnx.ModelProto:
    r"""Build the ONNX graph that renders one scene at any size.

    Input ``size``, int64 (2,): height and width of the image. Output ``image``, float32 :math:`(1, C, H, W)`: what
    :class:`kcgs.nn.RegionSplatRenderer` renders at that size. No operator scatters, so that it runs on WebGPU. Memory
    and time are those of the pixels times the Gaussians on each: for parts of very large images there is ``view``.

    Args:
        scene: one scene, no batch.
        cutoff: weights below it are skipped, as in :func:`kcgs.functional.region_splat`.
        clamp: clip the image to [0, 1]; False: as the renderer gives it, which may be below 0 and above 1.
        interactive: two more inputs. ``view``, float32 (4,): left, top, right and bottom of the part of the scene that
            fills the image, in pixels of the scene. ``visible``, float32 (R,): a factor on the Gaussians of each
            region, in the order of the map's ids.
        contours: "scaled" or "crisp", as :class:`kcgs.RegionSplatRenderer` takes them.

    Returns:
        A checked model; its metadata say what it is, and by which recipe the scene was fitted if the scene knows:
        see :func:`describe_decoder`.

    Raises:
        TypeError: wrong types.
        ValueError: a batch, regions of another size or without region ids, a number out of range.

    Example:
        >>> import numpy as np, onnxruntime
        >>> from kcgs import GaussianField
        >>> model = scene_decoder(Scene(GaussianField.random(10, (32, 48), seed=0)))
        >>> session = onnxruntime.InferenceSession(model.SerializeToString())
        >>> session.run(None, {"size": np.array([64, 96])})[0].shape
        (1, 3, 64, 96)
    """
    regions = check_scene(scene).regions
    if regions is not None and regions.resized:
        raise ValueError("scene must have the map itself; got one that was resized")
    cutoff = check_cutoff(cutoff)
    crisp = check_contours(contours) == "crisp" and regions is not None
    if crisp and regions is not None:  # what crisp contours are made of is as wide as one label
        regions = RegionMap.from_labels(regions.labels, 1.0)
    layout = lay_out(scene.field, regions, cutoff)

    g = Graph()
    down, across, visible = _inputs(g, scene, interactive)
    stored = Stored(g, layout, visible)
    blocks, windows = Blocks(g, stored, down, across, cutoff), None
    if regions is not None and any(group.regions > 1 for group in layout.groups):
        windows = Windows(g, layout.tiles, layout.groups, down, across, regions, crisp)
    planes = None if layout.nodes is None else Planes(g, stored, layout.nodes, down, across, cutoff)
    image = blocks.render(windows, planes)
    branches = {
        "then_branch": g.body(lambda inner: [across.shrink(inner, down.shrink(inner, image, 2), 3)], "smaller"),
        "else_branch": g.body(lambda inner: [inner("Identity", image)], "as_it_is"),
    }
    smaller = g("Or", *(g("Less", axis.output, axis.size) for axis in (down, across)))
    result = g("If", smaller, **branches)
    if clamp:
        result = g("Clip", result, np.float32(0), np.float32(1))
    shape = [1, stored.channels, "height", "width"]
    docs = f"Renders one image at any size: {scene.num_gaussians} Gaussians of a kcgs scene."
    facts = describe(scene, cutoff=cutoff, clamp=clamp, crisp=crisp)
    return g.finish("image", result, np.float32, shape, facts, (docs, image_doc(stored.channels, clamp)))


def _inputs(g: Graph, scene: Scene, interactive: bool) -> tuple[Axis, Axis, Value | None]:
    size = g.input("size", np.int64, [2], "height and width of the image in pixels, 1 or more each")
    rows, cols = g.apply("Split", [size], 2, axis=0, num_outputs=2)
    height, width = scene.size
    if not interactive:
        return Axis(g, rows, height), Axis(g, cols, width), None
    bounds = f"left, top, right, bottom of the part to render; the whole is 0, 0, {width}, {height}, in pixels"
    view = g.input("view", np.float32, [4], bounds)
    left, top, right, bottom = g.apply("Split", [view], 4, axis=0, num_outputs=4)
    factors = "factor on each region, 0 hidden to 1 shown; in the order of the metadata's region_ids"
    visible = g.input("visible", np.float32, [1 if scene.regions is None else scene.regions.num_regions], factors)
    return Axis(g, rows, height, (top, bottom)), Axis(g, cols, width, (left, right)), visible
