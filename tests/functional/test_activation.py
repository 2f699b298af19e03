"""Any real numbers become valid Gaussians."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField
from kcgs.functional import activate_gaussians
from tests.tester import BaseTester

SPACING = 4.0


def sample(*lead: int, scale: float = 1.0, channels: int = 3, dtype: torch.dtype = torch.float32) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return (scale * torch.randn(*lead, 5 + channels, generator=generator, dtype=torch.float64)).to(dtype)


def grid(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.arange(2 * count, dtype=dtype).view(count, 2)


class TestActivateGaussians(BaseTester):
    def test_smoke(self, device: torch.device, dtype: torch.dtype) -> None:
        raw = sample(2, 5, dtype=dtype).to(device)
        gaussians = activate_gaussians(raw, grid(5).to(device), SPACING)
        assert all(bool(t.isfinite().all() and t.any()) for t in gaussians)
        assert {t.dtype for t in gaussians} == {torch.float64 if dtype == torch.float64 else torch.float32}

    @pytest.mark.parametrize(("lead", "channels"), [((5,), 1), ((3, 2, 5), 4)])
    def test_cardinality(self, lead: tuple[int, ...], channels: int) -> None:
        raw = sample(*lead, channels=channels)
        shapes = [tuple(t.shape) for t in activate_gaussians(raw, grid(5), SPACING)]
        assert shapes == [(*lead, 2), (*lead, 3), (*lead, channels)]
        for one, other in zip(
            activate_gaussians(raw, grid(5).expand(*lead, 2), SPACING),
            activate_gaussians(raw, grid(5), SPACING),
            strict=True,
        ):
            assert torch.equal(one, other)

    @pytest.mark.parametrize(
        ("arguments", "error", "words"),
        [
            ((torch.ones(5, 8).long(), grid(5), 4.0), TypeError, "raw must have a real floating dtype"),
            ((torch.ones(5, 5), grid(5), 4.0), ValueError, r"raw must have shape \(..., N, 5 \+ C\); got \(5, 5\)"),
            ((torch.ones(5, 8), grid(4), 4.0), ValueError, r"anchors must have shape \(5, 2\)"),
            ((torch.ones(5, 8), torch.ones(5, 3), 4.0), ValueError, r"anchors must have shape \(..., 2\)"),
            ((torch.ones(5, 8), grid(5), 0.0), ValueError, "spacing must be finite and above 0; got 0"),
            ((torch.ones(5, 8), grid(5), torch.ones(1)), TypeError, "spacing must be a number"),
        ],
    )
    def test_exception(self, arguments: tuple, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            activate_gaussians(*arguments)

    def test_feature(self) -> None:
        """Zeros are round Gaussians at the anchors; a small number is a step in units of the spacing."""
        means, cholesky, colors = activate_gaussians(torch.zeros(5, 8), grid(5), SPACING)
        assert torch.equal(means, grid(5)) and not colors.any()
        assert torch.equal(cholesky, torch.tensor([2.0, 0.0, 2.0]).expand(5, 3))
        step = 1e-3
        means, cholesky, colors = activate_gaussians(torch.full((5, 6), step, dtype=torch.float64), grid(5), SPACING)
        self.assert_close(means, grid(5).double() + SPACING * step, atol=1e-6)
        self.assert_close(
            cholesky, torch.tensor([[2 * math.exp(step), 2 * step, 2 * math.exp(step)]]).expand(5, 3), atol=1e-6
        )
        self.assert_close(colors, torch.full((5, 1), step, dtype=torch.float64))

    @pytest.mark.parametrize(("scale", "spacing"), [(1.0, 0.5), (1e30, 64.0)])
    def test_any_numbers_are_valid(self, scale: float, spacing: float) -> None:
        """Within the documented ranges, however large the numbers are; a field takes them."""
        means, cholesky, colors = activate_gaussians(sample(200, scale=scale), grid(200), spacing)
        GaussianField(means, cholesky, colors, size=(16, 16))
        distance, units = (means - grid(200)).abs() / spacing, cholesky / spacing
        assert float(distance.max()) <= 1 + 1e-4
        assert 1 / 16 - 1e-6 <= float(units[:, ::2].min()) and float(units.abs().max()) <= 4 + 1e-5

    def test_gradcheck(self) -> None:
        def render_inputs(raw: Tensor, anchors: Tensor) -> Tensor:
            return torch.cat(activate_gaussians(raw, anchors, SPACING), -1)

        self.gradcheck(render_inputs, (sample(5), grid(5)))

    def test_module(self) -> None:
        """At the end of a network, under autocast, means keep full precision."""
        network = nn.Linear(4, 8)
        with torch.autocast("cpu", torch.bfloat16):
            means, _, _ = activate_gaussians(network(torch.ones(5, 4)), 1000 + grid(5), SPACING)
        self.assert_close(means.diff(dim=0), torch.full((4, 2), 2.0), atol=1e-3)  # bfloat16 rounds 1000 to 4
        means.sum().backward()
        assert network.weight.grad is not None and network.weight.grad[:2].all()

    def test_dynamo(self) -> None:
        def scale(raw: Tensor) -> Tensor:
            return torch.cat(activate_gaussians(raw, grid(5), SPACING), -1)

        self.assert_compiles(scale, sample(5).requires_grad_())
