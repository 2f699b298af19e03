"""Tokens of Gaussians: an exact inverse, gradients, numbers of order one."""

from __future__ import annotations

import math

import pytest
import torch

from kcgs import GaussianField, Scene
from kcgs.functional import from_tokens, to_tokens

SIZE = (24, 40)


def field_of(batch: int | None = None, dtype: torch.dtype = torch.float64) -> GaussianField:
    generator = torch.Generator().manual_seed(0)
    shape = (9,) if batch is None else (batch, 9)
    means = torch.rand(*shape, 2, generator=generator, dtype=dtype) * torch.tensor([44.0, 28.0], dtype=dtype) - 2
    cholesky = torch.rand(*shape, 3, generator=generator, dtype=dtype) * 4 + 0.5
    cholesky[..., 1] -= 2.5
    colors = torch.rand(*shape, 3, generator=generator, dtype=dtype)
    return GaussianField(means, cholesky, colors, torch.arange(9).expand(shape), size=SIZE)


@pytest.mark.parametrize("batch", [None, 4])
def test_there_and_back(batch: int | None) -> None:
    field = field_of(batch)
    twin = GaussianField.from_tokens(field.tokens(), field.region_ids, size=SIZE)
    for name in ("means", "cholesky", "colors", "region_ids"):
        torch.testing.assert_close(getattr(twin, name), getattr(field, name), rtol=1e-12, atol=1e-12)
    assert field.tokens().abs().max() < 5


def test_by_hand() -> None:
    means, cholesky = torch.tensor([[40.0, 6.0]]), torch.tensor([[math.sqrt(960.0), 3.0, 1.0]])
    tokens = to_tokens(means, cholesky, torch.tensor([[0.25, 0.5]]), SIZE)
    root = math.sqrt(960.0)
    torch.testing.assert_close(tokens, torch.tensor([[1.0, -0.5, 0.0, 3 / (root + 1), -math.log(root), 0.25, 0.5]]))


def test_gradients_go_through() -> None:
    field = field_of(2)
    tokens = field.tokens().detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda values: from_tokens(values, SIZE), tokens)
    assert torch.autograd.gradcheck(lambda *tables: to_tokens(*tables, SIZE), [p for p in field.parameters()])
    Scene(GaussianField.from_tokens(tokens, size=SIZE))().sum().backward()
    assert tokens.grad is not None and tokens.grad.abs().sum() > 0


def test_each_image_has_its_size() -> None:
    field, sizes = field_of(2), torch.tensor([SIZE, (48, 10)])
    tokens = to_tokens(field.means, field.cholesky, field.colors, sizes)
    for k, size in enumerate((SIZE, (48, 10))):
        torch.testing.assert_close(tokens[k], to_tokens(field.means[k], field.cholesky[k], field.colors[k], size))
    means, *_ = from_tokens(tokens, sizes)
    torch.testing.assert_close(means, field.means)


def test_opacities_are_multiplied_in() -> None:
    field = field_of()
    faint = GaussianField(field.means, field.cholesky, field.colors, opacities=torch.full((9,), 0.5), size=SIZE)
    torch.testing.assert_close(faint.tokens()[:, 5:], (0.5 * field.colors).float(), check_dtype=False)


def test_half_precision_holds_large_images() -> None:
    field, size = field_of(dtype=torch.float32), (480, 854)
    tokens = to_tokens(field.means.half(), field.cholesky.half(), field.colors.half(), size)
    assert tokens.dtype == torch.float32 and tokens.isfinite().all()
    for half, full in zip(from_tokens(tokens.half(), size), from_tokens(tokens, size), strict=True):
        torch.testing.assert_close(half, full, rtol=0.01, atol=0.5)


def test_exception() -> None:
    for function in (lambda *tokens, size: from_tokens(*tokens, size), GaussianField.from_tokens):
        with pytest.raises(ValueError, match=r"tokens must have 5 \+ C columns; got \(9, 5\)"):
            function(torch.zeros(9, 5), size=SIZE)
        with pytest.raises(ValueError, match="size must be at least 1 x 1; got .0, 8"):
            function(torch.zeros(9, 6), size=(0, 8))
    means, cholesky, colors = field_of().means, field_of().cholesky, field_of().colors
    for tables, words in (
        ((means, -cholesky, colors), "cholesky must have l11 > 0 and l22 > 0"),
        ((means, cholesky[:4], colors), r"cholesky must have shape \(9, 3\)"),
        ((means / 0, cholesky, colors), "means must be finite"),
    ):
        with pytest.raises(ValueError, match=words):
            to_tokens(*tables, SIZE)


@pytest.mark.parametrize("batch", [None, 2])
def test_flips_and_shifts_are_exact(batch: int | None) -> None:
    field = field_of(batch)
    field.region_ids = None
    render = Scene(field)()
    torch.testing.assert_close(Scene(field.hflip())(), render.flip(-1))
    torch.testing.assert_close(Scene(field.vflip())(), render.flip(-2))
    torch.testing.assert_close(Scene(field.shift(3, -2))()[..., :-2, 3:], render[..., 2:, :-3])
    assert field.hflip().means.grad_fn is not None
