"""From a scene to its decoder: what is asked for, what is checked, how the graph is put together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import onnx

from kcgs._check import check_cutoff
from kcgs.functional import RegionMap
from kcgs.functional.softness import check_contours
from kcgs.scene import Scene, check_scene

from .axis import Axis
from .blocks import Blocks
from .graph import Graph, Value
from .layout import Layout, lay_out
from .metadata import describe, image_doc
from .planes import Planes
from .stored import Stored
from .windows import Windows

PRECISIONS = ("fp32", "fp16")
# change of a value of the image that float16 may make
_LARGEST_CHANGE = 1 / 255


def scene_decoder(
    scene: Scene,
    *,
    cutoff: float = 1e-4,
    clamp: bool = True,
    precision: str = "fp32",
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
        precision: "fp32"; or "fp16": Cholesky factors and colours are stored in 16 bits, and computed with in 32.
        interactive: two more inputs. ``view``, float32 (4,): left, top, right and bottom of the part of the scene that
            fills the image, in pixels of the scene. ``visible``, float32 (R,): a factor on the Gaussians of each
            region, in the order of the map's ids.
        contours: "scaled" or "crisp", as :class:`kcgs.RegionSplatRenderer` takes them.

    Returns:
        A checked model; its metadata say what it is, by which recipe the scene was fitted if the scene knows, and what
        was left out: see :func:`describe_decoder`.

    Raises:
        TypeError: wrong types.
        ValueError: a batch, regions of another size or without region ids, a number out of range; "fp16" where it
            changes a value of the image, at its own size or twice that, by 1/255 or more.

    Example:
        >>> import numpy as np, onnxruntime
        >>> from kcgs import GaussianField
        >>> model = scene_decoder(Scene(GaussianField.random(10, (32, 48), seed=0)))
        >>> session = onnxruntime.InferenceSession(model.SerializeToString())
        >>> session.run(None, {"size": np.array([64, 96])})[0].shape
        (1, 3, 64, 96)
    """
    _check(scene)
    cutoff = check_cutoff(cutoff)
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}; got {precision!r}")
    regions = scene.regions
    crisp = check_contours(contours) == "crisp" and regions is not None
    if crisp and regions is not None:  # what crisp contours are made of is as wide as one label
        k = regions.supersample
        regions = RegionMap.from_labels(regions.fine_labels, 1.0 / k, supersample=k)
    layout = lay_out(scene.field, regions, cutoff)
    facts = describe(scene, layout, cutoff=cutoff, clamp=clamp, crisp=crisp)
    plan = _Plan(scene, regions, layout, cutoff, clamp, interactive, crisp)
    exact = plan.build("fp32", facts)
    if precision == "fp32":
        return exact
    half = plan.build("fp16", facts)
    _check_change(exact, half, plan)
    return half


class _Plan(NamedTuple):
    """What a graph is built of."""

    scene: Scene
    regions: RegionMap | None
    layout: Layout
    cutoff: float
    clamp: bool
    interactive: bool
    crisp: bool

    @property
    def num_regions(self) -> int:
        return 1 if self.regions is None else self.regions.num_regions

    def build(self, precision: str, facts: Mapping[str, str]) -> onnx.ModelProto:
        """Build the graph."""
        g = Graph()
        down, across, visible = self._inputs(g)
        stored = Stored(g, self.layout, visible, half=precision == "fp16")
        blocks = Blocks(g, stored, down, across, self.cutoff)
        regions, windows = self.regions, None
        if regions is not None and any(group.regions > 1 for group in self.layout.groups):
            windows = Windows(g, self.layout.tiles, self.layout.groups, down, across, regions, self.crisp)
        planes = None if self.layout.nodes is None else Planes(g, stored, self.layout.nodes, down, across, self.cutoff)
        image = blocks.render(windows, planes)
        branches = {
            "then_branch": g.body(lambda inner: [across.shrink(inner, down.shrink(inner, image, 2), 3)], "smaller"),
            "else_branch": g.body(lambda inner: [inner("Identity", image)], "as_it_is"),
        }
        smaller = g("Or", *(g("Less", axis.output, axis.size) for axis in (down, across)))
        image = g("If", smaller, **branches)
        if self.clamp:
            image = g("Clip", image, np.float32(0), np.float32(1))
        shape = [1, stored.channels, "height", "width"]
        docs = f"Renders one image at any size: {self.scene.num_gaussians} Gaussians of a kcgs scene."
        output = image_doc(stored.channels, self.clamp)
        return g.finish("image", image, np.float32, shape, {**facts, "precision": precision}, (docs, output))

    def _inputs(self, g: Graph) -> tuple[Axis, Axis, Value | None]:
        size = g.input("size", np.int64, [2], "height and width of the image in pixels, 1 or more each")
        rows, cols = g.apply("Split", [size], 2, axis=0, num_outputs=2)
        height, width = self.scene.size
        if not self.interactive:
            return Axis(g, rows, height), Axis(g, cols, width), None
        bounds = f"left, top, right, bottom of the part to render; the whole is 0, 0, {width}, {height}, in pixels"
        view = g.input("view", np.float32, [4], bounds)
        left, top, right, bottom = g.apply("Split", [view], 4, axis=0, num_outputs=4)
        factors = "factor on each region, 0 hidden to 1 shown; in the order of the metadata's region_ids"
        visible = g.input("visible", np.float32, [self.num_regions], factors)
        return Axis(g, rows, height, (top, bottom)), Axis(g, cols, width, (left, right)), visible


def _check(scene: object) -> None:
    regions = check_scene(scene).regions
    if regions is not None and regions.resized:
        raise ValueError("scene must have the map itself; got one that was resized")


def _check_change(exact: onnx.ModelProto, half: onnx.ModelProto, plan: _Plan) -> None:
    import onnxruntime

    feeds: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {}
    if plan.interactive:
        feeds["view"] = np.array([0, 0, *plan.scene.size[::-1]], np.float32)
        feeds["visible"] = np.ones(plan.num_regions, np.float32)
    sessions = [onnxruntime.InferenceSession(m.SerializeToString()) for m in (exact, half)]
    for factor in (1, 2):
        feeds["size"] = factor * np.array(plan.scene.size)
        images = [session.run(None, feeds)[0] for session in sessions]
        change = float(np.abs(images[0] - images[1]).max())
        if not change < _LARGEST_CHANGE:
            raise ValueError(
                f"precision must be fp32 for this scene: fp16 changes a value of the image by {change:.2g}, which is "
                f"not below 1/255 = {_LARGEST_CHANGE:.2g}"
            )
