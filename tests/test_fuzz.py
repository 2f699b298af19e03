"""Random shapes, dtypes and values: renders and fits work, or raise ValueError or TypeError."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kcgs import FitConfig, GaussianField, RegionMap, RegionSplatRenderer, fit
from kcgs.functional import region_splat

DTYPES = [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool]
VALUES = [0.0, 1.0, -1.0, 0.3, 7.0, 1e-9, 1e9, 3e38, math.inf, math.nan]
fuzz = settings(max_examples=50)


@st.composite
def tensors(draw: st.DrawFn, likely: tuple[int, ...]) -> object:
    """A tensor of the likely shape most of the time, now and then something else altogether."""
    kind = draw(st.integers(0, 11))
    if kind == 0:
        return draw(st.sampled_from([None, 3, b"x", [[1.0]]]))
    shape = tuple(draw(st.lists(st.integers(0, 5), max_size=4))) if kind == 1 else likely
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    tensor = torch.rand(shape, generator=generator, dtype=torch.float64) * draw(st.sampled_from([1.0, 9.0, 255.0]))
    if kind == 2 and tensor.numel():
        tensor.view(-1)[0] = draw(st.sampled_from(VALUES))
    dtype = draw(st.sampled_from(DTYPES)) if kind == 3 else torch.float32
    return tensor.to(dtype)


@st.composite
def label_maps(draw: st.DrawFn, likely: tuple[int, ...]) -> object:
    value = draw(tensors(likely))
    return value.long() if isinstance(value, Tensor) and draw(st.integers(0, 5)) else value


def works_or_refuses(call: Callable[[], object]) -> object:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        warnings.filterwarnings("ignore", message=".*regions get no Gaussian")  # true of random label maps
        try:
            return call()
        except (ValueError, TypeError) as error:
            assert str(error), "an error has a message"
            return None


@fuzz
@given(
    means=tensors((4, 2)), cholesky=tensors((4, 3)), colors=tensors((4, 3)), ids=label_maps((4,)),
    labels=label_maps((6, 7)), softness=st.sampled_from([0.0, 0.7, -1.0, math.nan, 100.0]),
    cutoff=st.sampled_from([0.0, 1e-4, 0.5, 1.0, -1.0, math.nan]), backend=st.sampled_from(["auto", "reference", "no"]),
)  # fmt: skip
def test_region_splat(
    means: Tensor, cholesky: Tensor, colors: Tensor, ids: Tensor, labels: Tensor, softness: float, cutoff: float,
    backend: str,
) -> None:  # fmt: skip
    def call() -> object:
        regions = RegionMap(labels, softness) if softness else labels
        image = region_splat(means, cholesky, colors, ids, regions, cutoff=cutoff, backend=backend)
        assert torch.isfinite(image).all() or image.dtype == torch.float16 or colors.abs().max() > 1e30
        return image

    works_or_refuses(call)


@pytest.mark.filterwarnings("ignore:.* Gaussians paint nothing")
@fuzz
@given(
    means=tensors((4, 2)), cholesky=tensors((4, 3)), colors=tensors((4, 1)), ids=label_maps((4,)),
    labels=label_maps((6, 7)), size=st.sampled_from([(6, 7), (7, 6), (0, 1), 5, (2.0, 3), None]),
    target=st.sampled_from([None, (6, 7), (13, 5), (-1, 2)]),
)  # fmt: skip
def test_modules(
    means: Tensor, cholesky: Tensor, colors: Tensor, ids: Tensor, labels: Tensor, size: object, target: object
) -> None:
    def call() -> object:
        field = GaussianField(means, cholesky, colors, ids, size=size)  # type: ignore[arg-type]
        return RegionSplatRenderer()(field, labels, target)

    works_or_refuses(call)


@settings(fuzz, max_examples=25)
@given(image=tensors((3, 8, 9)), labels=label_maps((8, 9)), n=st.sampled_from([1, 3, 0, -1, 2.0, True]))
def test_fit(image: Tensor, labels: Tensor, n: int) -> None:
    config = FitConfig.from_recipe("paper", iterations=2)
    works_or_refuses(lambda: fit(image, labels, n, recipe=config))
