"""`scene_decoder`: the graph of one scene. The package's docstring lists its parts."""

from __future__ import annotations

import onnx

from kcgs._check import check_cutoff
from kcgs.errors import InvalidArgument
from kcgs.functional import check_values
from kcgs.scene import Scene, check_scene

from .axis import Axis
from .blocks import BlockRenderer
from .entries import store_entries
from .graph import FLOAT, INT64, Graph, Value
from .grids import CoarseGrids
from .membership import MembershipSampler
from .metadata import image_doc, scene_metadata
from .plan import plan_decoder


def scene_decoder(
    scene: Scene,
    *,
    cutoff: float = 1e-4,
    clamp: bool = True,
    interactive: bool = False,
) -> onnx.ModelProto:
    r"""Build the ONNX graph that renders one scene at any size.

    Input ``size``, int64 (2,): height and width of the image. Output ``image``, float32 :math:`(1, C, H, W)`: the
    render of :class:`kcgs.nn.RegionSplatRenderer` at this size. The graph runs on WebGPU, since no operator scatters.
    Memory and time grow with the pixels and with the Gaussians at each pixel. The input ``view`` selects a part of a
    very large image.

    Args:
        scene: one scene, no batch.
        cutoff: weights below it are skipped, as in :func:`kcgs.functional.region_splat`.
        clamp: clip the image to [0, 1]; False: values may be below 0 and above 1, as in the renderer.
        interactive: add two inputs. ``view``, float32 (4,): left, top, right and bottom of the part of the scene that
            fills the image, in pixels of the scene; left < right and top < bottom. ``visible``, float32 (R,): a factor
            on the Gaussians of each region, in the order of the map's ids.

    Returns:
        A checked model for `onnx.save`; :func:`describe_decoder` reads its metadata.

    Raises:
        TypeError: wrong types.
        ValueError: a batch; regions of another size, or without region ids; a cutoff out of range; Gaussians that are
            not finite or out of range.

    Example:
        >>> import numpy as np, onnxruntime
        >>> from kcgs import GaussianField
        >>> model = scene_decoder(Scene(GaussianField.random(10, (32, 48), seed=0)))
        >>> session = onnxruntime.InferenceSession(model.SerializeToString())
        >>> session.run(None, {"size": np.array([64, 96])})[0].shape
        (1, 3, 64, 96)
    """
    regions = check_scene(scene).regions
    if regions is not None and regions.is_resampled:
        raise InvalidArgument("scene", "the map itself", "one that was resized", verb="have")
    cutoff = check_cutoff(cutoff)
    field = scene.field
    check_values(*(values.detach().float() for values in (field.means, field.cholesky, field.merged_colors())))
    plan = plan_decoder(field, regions, cutoff)

    g = Graph()
    down, across, visible = _inputs(g, scene, interactive)
    storage = store_entries(g, plan, visible)
    blocks = BlockRenderer(storage, down, across, cutoff)
    membership = MembershipSampler(storage, down, across) if plan.mixed_tiles else None
    grids = None if storage.table is None else CoarseGrids(storage, storage.table, down, across, cutoff)
    image = _crop(g, blocks.image(membership, grids), down, across)
    if clamp:
        image = g.Clip(image, 0.0, 1.0)
    return g.close(
        image,
        "image",
        [1, storage.channels, "height", "width"],
        image_doc(storage.channels, clamp),
        graph_doc=f"Renders one image at any size: {scene.num_gaussians} Gaussians of a kcgs scene.",
        metadata=scene_metadata(scene, cutoff=cutoff, clamp=clamp),
    )


def _inputs(g: Graph, scene: Scene, interactive: bool) -> tuple[Axis, Axis, Value | None]:
    """Declare the inputs; return rows and columns of the output, and the factors on regions if there are any."""
    size = g.input("size", INT64, [2], "height and width of the image in pixels, 1 or more each")
    rows, cols = g.split(size, 2)
    height, width = scene.size
    if not interactive:
        return Axis(g, rows, height), Axis(g, cols, width), None
    bounds = f"left, top, right, bottom of the part to render; the whole is 0, 0, {width}, {height}, in pixels"
    view = g.input("view", FLOAT, [4], bounds)
    left, top, right, bottom = g.split(view, 4)
    factors = "factor on each region, 0 hidden to 1 shown; in the order of the metadata's region_ids"
    visible = g.input("visible", FLOAT, [1 if scene.regions is None else scene.regions.num_regions], factors)
    return Axis(g, rows, height, (top, bottom)), Axis(g, cols, width, (left, right)), visible


def _crop(g: Graph, image: Value, down: Axis, across: Axis) -> Value:
    """Remove spare pixels, and reduce an image that was rendered larger than the output."""

    def crop() -> Value:
        return g.Slice(image, [0, 0], g.Concat(down.size, across.size, axis=0), [2, 3])

    def select() -> Value:
        rows, columns = down.places(), across.places()

        def crop_uneven() -> Value:
            lines = g.Transpose(g.Gather(image, rows, axis=2), perm=[0, 1, 3, 2])
            return g.Transpose(g.Gather(lines, columns, axis=2), perm=[0, 1, 3, 2])

        return g.choose(is_smaller, lambda: across.shrink(down.shrink(image, rows, 2), columns, 3), crop_uneven)

    is_smaller = g.Or(*(g.Less(axis.output, axis.size) for axis in (down, across)))
    return g.choose(g.And(g.And(down.is_even(), across.is_even()), g.Not(is_smaller)), crop, select)
