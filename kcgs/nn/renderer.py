"""RegionSplatRenderer: the module twin of region_splat."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor, nn

from kcgs._check import check_cutoff, check_size
from kcgs.functional import RegionMap
from kcgs.functional.splat import as_map, map_size, splat_at

from .field import GaussianField


class SceneLike(Protocol):
    """Gaussians with the map to render them with, such as :class:`kcgs.Scene`."""

    field: GaussianField
    regions: RegionMap | None


class RegionSplatRenderer(nn.Module):
    r"""Render a field, at its own size or any other.

    Convention: at another size the Gaussians are scaled and the label map is sampled again, so that contours stay
    sharp. The module holds no state.

    Args:
        cutoff: weights below it are skipped, in [0, 1); see :func:`kcgs.functional.region_splat`.
        clamp: clip the image to [0, 1].
        backend: auto, reference, tiled, cpu or cuda.
        keepdim: give (C, H, W) for an unbatched field; False: always (B, C, H, W), as Kornia's modules take it.

    Raises:
        ValueError: cutoff out of range.

    Example:
        >>> field = GaussianField.random(10, (32, 48), seed=0)
        >>> RegionSplatRenderer()(field).shape, RegionSplatRenderer()(field, size=(64, 96)).shape
        (torch.Size([3, 32, 48]), torch.Size([3, 64, 96]))
    """

    def __init__(self, cutoff: float = 1e-4, clamp: bool = False, backend: str = "auto", keepdim: bool = True) -> None:
        super().__init__()
        self.cutoff = check_cutoff(cutoff)
        self.clamp = clamp
        self.backend = backend
        self.keepdim = keepdim

    def forward(
        self,
        field: GaussianField | SceneLike,
        regions: RegionMap | Tensor | None = None,
        size: tuple[int, int] | None = None,
    ) -> Tensor:
        """Render.

        Args:
            field: the Gaussians; or a :class:`kcgs.Scene`, which brings its map along, so that the renderer can be the
                first link of an `nn.Sequential`.
            regions: label map of the field's size or of `size`; None: the scene's, or none, where the field has no ids.
            size: (height, width) of the image; None: the field's.

        Returns:
            Image, :math:`(C, H, W)`, or :math:`(B, C, H, W)` for a batched field or with ``keepdim=False``.

        Raises:
            TypeError, ValueError: as :func:`kcgs.functional.region_splat`; regions without region ids, or ids without
                regions.

        Warns:
            UserWarning: Gaussians whose region ids the map does not hold; they paint nothing.
        """
        if not isinstance(field, GaussianField):
            # not by isinstance of the protocol, which takes as long as the rest of this module
            scene, inner = field, getattr(field, "field", None)
            if not isinstance(inner, GaussianField):
                raise TypeError(f"field must be a GaussianField or a Scene; got {type(field).__name__}")
            field, regions = inner, scene.regions if regions is None else regions
        target = field.size if size is None else check_size("size", size)
        means, cholesky, ids = field.means, field.cholesky, field.region_ids
        if target != field.size:
            down, across = target[0] / field.size[0], target[1] / field.size[1]
            means = means * means.new_tensor([across, down])
            cholesky = cholesky * cholesky.new_tensor([across, down, down])
        if regions is not None:
            if ids is None:
                raise ValueError(
                    "field must have region_ids where regions are given; call field.assign_regions(regions)"
                )
            regions = as_map(regions)
            found = map_size(regions)
            if found not in (target, field.size):
                raise ValueError(f"regions must have the size {field.size} of the field or {target}; got {found}")
        elif ids is not None:
            raise ValueError(
                "regions must be given for a field that is confined to regions; got None: pass its label map or its "
                "Scene, or set field.region_ids to None to render it without contours"
            )
        image = splat_at(
            target, means, cholesky, field.merged_colors(), ids, regions, cutoff=self.cutoff, backend=self.backend
        )
        if not self.keepdim and image.ndim == 3:
            image = image[None]
        return image.clamp(0.0, 1.0) if self.clamp else image

    def to_onnx(self, onnx_name: str = "Kornia-RegionSplatRenderer.onnx", **settings: Any) -> Any:
        """Export for any Gaussians and label maps, by Kornia's `ONNXExportMixin`.

        Takes what Kornia's ``to_onnx`` takes; ``input_shape`` and ``pseudo_shape`` are those of the image. Returns the
        `onnx.ModelProto`: batches of means, cholesky, colors, region_ids and labels in, the image out.
        """
        from .onnx_export import RendererExport

        return RendererExport(self).to_onnx(onnx_name, **settings)

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"cutoff={self.cutoff:g}, clamp={self.clamp}, backend={self.backend!r}, keepdim={self.keepdim}"
