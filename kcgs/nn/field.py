"""GaussianField: parameters and region ids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kcgs._check import (
    check_count,
    check_floating,
    check_ids,
    check_integer,
    check_number,
    check_rows,
    check_size,
    check_tensor,
)
from kcgs._labels import check_labels
from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.functional import check_cholesky, from_tokens, to_tokens
from kcgs.maps import RegionMap, lookup_regions

_HALF = (torch.float16, torch.bfloat16)
_TABLES = ("means", "cholesky", "colors", "region_ids", "opacities")


class GaussianField(nn.Module):
    r"""Gaussians of an image, or of a batch of images, with the region that each may paint.

    Convention: an `nn.Parameter` is registered as it is; another tensor that requires a gradient (say, the output of a
    network) stays in its graph, as a buffer; of any other tensor a copy becomes a parameter. Half precision cannot hold
    a pixel position, so `.half()` and `.bfloat16()` leave the field in float32 and warn.

    Args:
        means: centres (x, y) in pixels, :math:`(N, 2)` or :math:`(B, N, 2)`.
        cholesky: factors (l11, l21, l22) in pixels, l11, l22 > 0, :math:`(N, 3)` or :math:`(B, N, 3)`.
        colors: any range, :math:`(N, C)` or :math:`(B, N, C)`.
        region_ids: integer, non-negative, :math:`(N)` or :math:`(B, N)`; None: not confined.
        opacities: the paper's alpha, :math:`(N)` or :math:`(B, N)`; None: already multiplied into the colours. A field,
            edits and .safetensors files keep them beside the colours; renders, fits, shards and .kcgs files multiply
            them into the colours.
        size: (height, width) of the image that the pixel units refer to.

    Raises:
        TypeError: wrong type or dtype.
        ValueError: shapes that do not fit, values that are not finite, l11 or l22 not positive, negative ids.

    Example:
        >>> field = GaussianField.random(10, (32, 48), seed=0)
        >>> field.num_gaussians, field.size, field.colors.shape
        (10, (32, 48), torch.Size([10, 3]))

    Source: the paper's tuple (mu, Sigma, c, alpha, r).
    """

    means: Tensor
    cholesky: Tensor
    colors: Tensor
    region_ids: Tensor | None
    opacities: Tensor | None

    def __init__(
        self,
        means: Tensor,
        cholesky: Tensor,
        colors: Tensor,
        region_ids: Tensor | None = None,
        opacities: Tensor | None = None,
        *,
        size: tuple[int, int],
    ) -> None:
        super().__init__()
        self.size = check_size("size", size)
        check_floating("means", means, last=2, dims=(2, 3))
        check_cholesky("cholesky", cholesky)
        check_floating("colors", colors, dims=(2, 3))
        check_rows("cholesky", cholesky, means, 3)
        check_rows("colors", colors, means, "C")
        if opacities is not None and check_floating("opacities", opacities).shape != means.shape[:-1]:
            raise InvalidArgument("opacities", f"{tuple(means.shape[:-1])}", tuple(opacities.shape), verb="have shape")
        for name, table in (("means", means), ("cholesky", cholesky), ("colors", colors), ("opacities", opacities)):
            self._register(name, table)
        self.register_buffer("region_ids", None if region_ids is None else self._checked_ids(region_ids))

    def _register(self, name: str, value: Tensor | None) -> None:
        if value is not None and value.dtype in _HALF:
            value = value.float()
        if value is None or isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        elif value.requires_grad:
            self.register_buffer(name, value)
        else:
            self.register_parameter(name, nn.Parameter(value.detach().clone(memory_format=torch.contiguous_format)))

    def _checked_ids(self, region_ids: Tensor) -> Tensor:
        region_ids = check_tensor("region_ids", region_ids).to(self.means.device)
        return check_ids("region_ids", region_ids, self.means).clone()

    @property
    def num_images(self) -> int | None:
        """B of a batch; None: one image, without B."""
        return None if self.means.ndim == 2 else len(self.means)

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians per image."""
        return self.means.shape[-2]

    @classmethod
    def random(
        cls,
        num_gaussians: int,
        size: tuple[int, int],
        *,
        channels: int = 3,
        sigma: float | None = None,
        regions: RegionMap | Tensor | None = None,
        seed: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> GaussianField:
        """Sample round Gaussians: centres uniform over the image, and uniform colours that add up to about grey.

        Args:
            num_gaussians: N, at least 0.
            size: (height, width) in pixels.
            channels: C, at least 1.
            sigma: standard deviation in pixels; None: half the root of the area per Gaussian, at least 0.5.
            regions: assign each Gaussian the region under its centre.
            seed: of the samples; None: torch's global generator.
            dtype: float32 or float64.

        Raises:
            TypeError, ValueError: a number of another type or out of range.
        """
        height, width = check_size("size", size)
        check_count("num_gaussians", num_gaussians, 0)
        check_count("channels", channels)
        if sigma is None:
            sigma = max(0.5, 0.5 * (height * width / max(1, num_gaussians)) ** 0.5)
        check_number("sigma", sigma, 0.0, above=True)
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        means = torch.rand(num_gaussians, 2, generator=generator, dtype=dtype) * torch.tensor([width, height])
        cholesky = torch.tensor([sigma, 0.0, sigma], dtype=dtype).repeat(num_gaussians, 1)
        # a Gaussian's weights sum to 2 pi sigma^2 pixels: `overlap` is the mean sum of weights at a pixel
        overlap = max(1.0, 2 * torch.pi * sigma**2 * num_gaussians / (height * width))
        colors = torch.rand(num_gaussians, channels, generator=generator, dtype=dtype) / overlap
        field = cls(means.to(dtype), cholesky, colors, size=size)
        return field if regions is None else field.assign_regions(regions)

    def assign_regions(self, regions: RegionMap | Tensor) -> GaussianField:
        """Give every Gaussian the region under its centre, in place, and return the field; the map has its size."""
        labels = regions.labels if isinstance(regions, RegionMap) else check_labels("regions", regions)
        ids = lookup_regions(self.means, labels)
        if tuple(labels.shape[-2:]) != self.size:
            raise InvalidArgument("regions", f"the field's size {self.size}", tuple(labels.shape[-2:]), verb="have")
        self.register_buffer("region_ids", ids.to(self.means.device))
        return self

    def subset(self, mask: Tensor) -> GaussianField:
        """Copy the Gaussians that `mask` selects into a new field of unbatched parameters, without the graph.

        Args:
            mask: boolean (N), or integer indices (K).

        Raises:
            TypeError: neither boolean nor integer.
            ValueError: the field is batched, or the mask has another length or indices out of range.

        Example:
            >>> field = GaussianField.random(10, (32, 48), seed=0)
            >>> field.subset(field.means[:, 0] < 24).num_gaussians < 10
            True
        """
        if self.num_images is not None:
            raise ValueError(f"subset needs an unbatched field; got means of shape {tuple(self.means.shape)}")
        count = self.num_gaussians
        if check_tensor("mask", mask).dtype == torch.bool:
            if mask.shape != (count,):
                raise InvalidArgument("mask", f"shape ({count},)", tuple(mask.shape), verb="have")
        elif check_integer("mask", mask, dims=(1,)).numel() and not 0 <= int(mask.min()) <= int(mask.max()) < count:
            received = f"{int(mask.min())} to {int(mask.max())}"
            raise InvalidArgument("mask", f"indices in [0, {count})", received, verb="hold")
        return self._select(mask)

    def __getitem__(self, index: int | slice) -> GaussianField:
        """Copy one image of a batch, or a slice of it, into a field of parameters, without the graph.

        Raises:
            ValueError: the field is not batched.
            IndexError: there is no such image.

        Example:
            >>> means, cholesky, colors = torch.rand(4, 9, 2), torch.ones(4, 9, 3), torch.rand(4, 9, 3)
            >>> GaussianField(means, cholesky, colors, size=(8, 8))[-1].means.shape
            torch.Size([9, 2])
        """
        if self.num_images is None:
            raise ValueError(f"an index needs a batched field; got means of shape {tuple(self.means.shape)}")
        return self._select(index)

    @classmethod
    def stack(cls, fields: Sequence[GaussianField]) -> GaussianField:
        """Copy fields of one image each into a batch of parameters, without the graph; :meth:`unbind` is the reverse.

        Args:
            fields: at least one; alike in number of Gaussians, channels and size, all with region ids or none, and all
                with opacities or none.

        Raises:
            TypeError: not GaussianFields.
            ValueError: no fields, batched fields, or fields that differ.

        Example:
            >>> batch = GaussianField.stack([GaussianField.random(9, (8, 8), seed=seed) for seed in range(4)])
            >>> batch.means.shape, [field.num_gaussians for field in batch.unbind()]
            (torch.Size([4, 9, 2]), [9, 9, 9, 9])
        """
        for field in fields:
            if not isinstance(field, GaussianField):
                raise InvalidArgumentType("fields", "GaussianFields", type(field).__name__)
            if field.num_images is not None or field.extra_repr() != fields[0].extra_repr():
                expected = f"of one image each and alike, the first with {fields[0].extra_repr()}"
                raise InvalidArgument("fields", expected, f"one with {field.extra_repr()}")
        if not fields:
            raise InvalidArgument("fields", "at least one", "none", verb="hold")
        columns = ([getattr(field, name) for field in fields] for name in _TABLES)
        tensors = (None if column[0] is None else torch.stack(column).detach() for column in columns)
        return cls(*tensors, size=fields[0].size)  # type: ignore[arg-type]

    def unbind(self) -> list[GaussianField]:
        """Copy each image of a batch, as an index does."""
        return [self[index] for index in range(len(self.means))]

    def _select(self, index: int | slice | Tensor) -> GaussianField:
        tables = (getattr(self, name) for name in _TABLES)
        parts = (None if table is None else table.detach()[index] for table in tables)
        return GaussianField(*parts, size=self.size)  # type: ignore[arg-type]

    def tokens(self) -> Tensor:
        r"""Write the Gaussians as numbers of order one, for a network; opacities are multiplied into the colours.

        :func:`kcgs.functional.to_tokens` has the columns. Ids are beside them, in `region_ids`.

        Returns:
            :math:`(N, 5 + C)` or :math:`(B, N, 5 + C)`, with the graph.

        Example:
            >>> field = GaussianField.random(10, (32, 48), seed=0)
            >>> twin = GaussianField.from_tokens(field.tokens(), size=field.size)
            >>> field.tokens().shape, torch.allclose(twin.cholesky, field.cholesky)
            (torch.Size([10, 8]), True)
        """
        return to_tokens(self.means, self.cholesky, self.merged_colors(), self.size)

    @classmethod
    def from_tokens(cls, tokens: Tensor, region_ids: Tensor | None = None, *, size: tuple[int, int]) -> GaussianField:
        """Make a field of the tokens that :meth:`tokens` writes, differentiably.

        Args:
            tokens: floating, :math:`(N, 5 + C)` or :math:`(B, N, 5 + C)`, such as a network's output.
            region_ids: integer, :math:`(N)` or :math:`(B, N)`; None: not confined.
            size: (height, width) of the image.

        Raises:
            TypeError, ValueError: as the field; fewer than 6 columns.
        """
        check_floating("tokens", tokens, dims=(2, 3))
        return cls(*from_tokens(tokens, size), region_ids, size=size)

    def hflip(self) -> GaussianField:
        """Return the field flipped left to right, exactly, with the graph; flip a label map by ``labels.flip(-1)``.

        Example:
            >>> from kcgs import Scene
            >>> field = GaussianField.random(10, (32, 48), seed=0)
            >>> torch.allclose(Scene(field.hflip())(), Scene(field)().flip(-1), atol=1e-5)
            True
        """
        return self._mirror(0)

    def vflip(self) -> GaussianField:
        """Return the field of the image that is flipped upside down, exactly, with the graph."""
        return self._mirror(1)

    def shift(self, x: float, y: float) -> GaussianField:
        """Return the field moved by so many pixels to the right and down, with the graph."""
        return self._with_geometry(self.means + self.means.new_tensor([x, y]), self.cholesky)

    def _mirror(self, axis: int) -> GaussianField:
        """Mirror x (0) or y (1): the variances stay, and the covariance of x and y changes its sign."""
        signs, offsets = self.means.new_ones(2), self.means.new_zeros(2)
        signs[axis], offsets[axis] = -1.0, self.size[1 - axis]
        cholesky = self.cholesky * self.cholesky.new_tensor([1.0, -1.0, 1.0])
        return self._with_geometry(offsets + signs * self.means, cholesky)

    def _with_geometry(self, means: Tensor, cholesky: Tensor) -> GaussianField:
        return GaussianField(means, cholesky, self.colors, self.region_ids, self.opacities, size=self.size)

    def merged_colors(self) -> Tensor:
        """Return the colours with the opacities multiplied in, (N, C) or (B, N, C)."""
        return self.colors if self.opacities is None else self.colors * self.opacities[..., None]

    def without_opacities(self) -> GaussianField:
        """Return the field itself; with opacities, a copy of parameters with merged colours, without the graph."""
        if self.opacities is None:
            return self
        means, cholesky, colors = self.means.detach(), self.cholesky.detach(), self.merged_colors().detach()
        return GaussianField(means, cholesky, colors, self.region_ids, size=self.size)

    def get_extra_state(self) -> dict[str, tuple[int, int]]:
        """Return the size, for `state_dict`."""
        return {"size": self.size}

    def set_extra_state(self, state: dict[str, tuple[int, int]]) -> None:
        """Set the size, from `load_state_dict`."""
        self.size = check_size("size", tuple(state["size"]))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        means = state_dict.get(f"{prefix}means")
        if means is not None and means.shape != self.means.shape:
            raise InvalidArgument("state_dict", f"means {tuple(self.means.shape)}", tuple(means.shape), verb="hold")
        # torch ignores a buffer that is None: ids, or their absence, come from the state
        ids = state_dict.get(f"{prefix}region_ids")
        if ids is None and f"{prefix}means" in state_dict:
            self.region_ids = None
        elif self.region_ids is None and ids is not None and ids.shape == self.means.shape[:-1]:
            self.region_ids = self._checked_ids(ids)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GaussianField:
        if fn(self.means.detach().new_zeros(1)).dtype in _HALF:
            warn_user("GaussianField stays in float32: half precision cannot hold pixel positions")

        def keep_precision(tensor: Tensor) -> Tensor:
            result = fn(tensor)
            return tensor.to(result.device, torch.float32) if result.dtype in _HALF else result

        super()._apply(keep_precision, recurse)  # type: ignore[no-untyped-call]
        return self

    def extra_repr(self) -> str:
        """Return the numbers of images, Gaussians and channels, the size, and whether there are ids and opacities."""
        images = "" if self.num_images is None else f"{self.num_images} x "
        confined = "not confined" if self.region_ids is None else "confined"
        confined += "" if self.opacities is None else ", with opacities"
        return f"{images}{self.num_gaussians} Gaussians, {self.colors.shape[-1]} channels, size={self.size}, {confined}"
