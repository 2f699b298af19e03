"""RegionSplatRenderer: the module twin of region_splat."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn

from kcgs._check import check_cutoff, check_size
from kcgs._sizes import is_equal
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.functional import splat_at
from kcgs.kernels import check_backend
from kcgs.maps import RegionMap, table_and_size

from .field import GaussianField
from .rows import scaled_gaussians


class SceneLike(Protocol):
    """Gaussians with the map to render them with, such as :class:`kcgs.Scene`."""

    field: GaussianField
    regions: RegionMap | None


class RegionSplatRenderer(nn.Module):
    r"""Render a field, at its own size or any other.

    Convention: at another size the Gaussians are scaled and the label map is sampled again. A smaller image is the
    area mean of the image at the field's size. The module holds no state.

    Args:
        cutoff: weights below it are skipped, in [0, 1); see :func:`kcgs.functional.region_splat`.
        clamp: clip the image to [0, 1].
        backend: auto, reference, tiled, cpu or cuda.
        keepdim: give (C, H, W) for an unbatched field; False: always (B, C, H, W), as Kornia's modules take it.

    Raises:
        ValueError: cutoff out of range; an unknown backend.

    Example:
        >>> field = GaussianField.random(10, (32, 48), seed=0)
        >>> RegionSplatRenderer()(field).shape, RegionSplatRenderer()(field, size=(64, 96)).shape
        (torch.Size([3, 32, 48]), torch.Size([3, 64, 96]))
    """

    def __init__(self, cutoff: float = 1e-4, clamp: bool = False, backend: str = "auto", keepdim: bool = True) -> None:
        super().__init__()
        self.cutoff = check_cutoff(cutoff)
        self.clamp = clamp
        self.backend = check_backend(backend)
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
            regions: label map of the field's size or of `size`; None: the scene's map; a field without ids needs none.
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
            # isinstance(field, SceneLike) would take as long as the rest of this module
            if not isinstance(getattr(field, "field", None), GaussianField):
                raise InvalidArgumentType("field", "a GaussianField or a Scene", type(field).__name__)
            regions = field.regions if regions is None else regions
            field = field.field
        size = field.size if size is None else check_size("size", size)
        table, map_size = (None, size) if regions is None else table_and_size(regions)
        if table is None and field.region_ids is not None:
            raise InvalidArgument(
                "regions",
                "given for a field that is confined to regions",
                "None: pass its label map or its Scene, or set field.region_ids to None to render it without contours",
            )
        if table is not None and field.region_ids is None:
            raise ValueError("field must have region_ids where regions are given; call field.assign_regions(regions)")
        if map_size not in (field.size, size):
            other = "" if size == field.size else f" or {size}"
            raise InvalidArgument("regions", f"the size {field.size} of the field{other}", map_size, verb="have")
        # a map of the image's size cannot be sampled between its pixels: no larger render is averaged
        resized = table is not None and map_size != field.size
        fine = size if resized else rendered_size(field.size, size)
        means, cholesky = scaled_gaussians(field, fine)
        image = splat_at(
            fine, means, cholesky, field.merged_colors(), field.region_ids, table,
            cutoff=self.cutoff, backend=self.backend,
        )  # fmt: skip
        image = area_mean(image, size)
        if not self.keepdim and image.ndim == 3:
            image = image[None]
        return image.clamp(0.0, 1.0) if self.clamp else image

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"cutoff={self.cutoff:g}, clamp={self.clamp}, backend={self.backend!r}, keepdim={self.keepdim}"


def rendered_size(field_size: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
    """Return the size at which a field is rendered for an image of `size`: neither side below the field's."""
    return _larger(field_size[0], size[0]), _larger(field_size[1], size[1])


def _larger(a: int, b: int) -> int:
    # torch.export traces sizes that are no int, and max would make them constants; torch.compile of torch 2.11 lacks
    # sym_max of int
    return max(a, b) if isinstance(a, int) and isinstance(b, int) else torch.sym_max(a, b)


def area_mean(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Shrink an image, (..., H, W): a pixel is the mean over its share of the height and width, fractions included.

    Example:
        >>> area_mean(torch.tensor([[0.0, 3.0, 6.0]]), (1, 2))
        tensor([[1., 5.]])
    """
    rows = _shrink(image, -2, size[0])
    return _shrink(rows, -1, size[1])


def _shrink(image: Tensor, dim: int, size: int) -> Tensor:
    length = image.shape[dim]
    if is_equal(size, length):
        return image
    begin = torch.arange(size, device=image.device) * length  # in units of 1 / (size * length) of the whole side

    def share(line: Tensor) -> Tensor:
        overlap = torch.minimum(begin + length, (line + 1) * size) - torch.maximum(begin, line * size)
        return overlap.clamp_min(0).to(image.dtype) / length

    if not torch.compiler.is_compiling():  # many times as fast as the matrix of a graph for any size
        total = torch.zeros_like(image.narrow(dim, 0, size))
        for step in range(length // size + 2 * (length % size > 0)):
            line = begin // size + step
            lines = image.index_select(dim, line.clamp_max(length - 1))
            total = total + lines * (share(line) if dim == -1 else share(line)[:, None])
        return total
    matrix = share(torch.arange(length, device=image.device)[:, None])  # (length, size)
    with torch.autocast(image.device.type, enabled=False):
        return image @ matrix if dim == -1 else matrix.T @ image
