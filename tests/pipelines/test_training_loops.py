"""Loops that people write around the renderer: GaussianAdam under losses of their own, and steps that fail."""

from __future__ import annotations

from collections.abc import Callable

import kornia
import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionSplatRenderer
from kcgs.fitting import initial_field
from kcgs.optim import GaussianAdam

SIZE = (24, 36)
Loss = Callable[[Tensor, Tensor], Tensor]


def target(count: int = 1, dtype: torch.dtype = torch.float32) -> Tensor:
    """Draw discs on slopes, (B, 3, H, W)."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=dtype) for n in SIZE), indexing="ij")
    images = []
    for k in range(count):
        disc = ((x - 12 - 4 * k) ** 2 + (y - 12) ** 2 < 50).to(dtype)
        images.append(torch.stack([x / 40, disc, 0.8 - y / 40]))
    return torch.stack(images)


def halves() -> Tensor:
    return (torch.arange(SIZE[1]) > 17).long().expand(SIZE).contiguous()


def batch_field(dtype: torch.dtype) -> GaussianField:
    fields = [initial_field(image, 40, halves()) for image in target(2, dtype)]
    tensors = (
        torch.stack([getattr(field, name).detach() for field in fields]) for name in ("means", "cholesky", "colors")
    )
    return GaussianField(*tensors, torch.stack([f.region_ids for f in fields if f.region_ids is not None]), size=SIZE)


def features() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.GELU(), nn.Conv2d(8, 8, 3, stride=2)).requires_grad_(False)


def feature_loss() -> Loss:
    network = features()
    return lambda render, image: (network.to(render)(render) - network.to(image)(image)).square().mean()


LOSSES: dict[str, Loss] = {
    "squared error": lambda render, image: (render - image).square().mean(),
    "L1": lambda render, image: (render - image).abs().mean(),
    "SSIM": lambda render, image: kornia.losses.ssim_loss(render, image, window_size=5),
    "features": feature_loss(),
    "L1 and total variation": lambda render, image: (
        (render - image).abs().mean() + 0.02 * kornia.losses.total_variation(render, reduction="mean").mean()
    ),
}


class TestLossesFall:
    @pytest.mark.parametrize("kind", ["one", "double", "batch", "tiled"])
    @pytest.mark.parametrize("name", LOSSES)
    def test_in_fifty_steps(self, name: str, kind: str, device: torch.device) -> None:
        """At the default rate, with a schedule; the field is valid at every step, since the renderer takes it."""
        dtype = torch.float64 if kind == "double" else torch.float32
        image = target(2 if kind == "batch" else 1, dtype).to(device)
        field = batch_field(dtype) if kind == "batch" else initial_field(image, 40, halves())
        regions = halves().to(device)
        renderer = RegionSplatRenderer(keepdim=False, backend="tiled" if kind == "tiled" else "auto")
        optimizer = GaussianAdam(field.to(device))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 50)
        losses = []
        for _ in range(50):
            loss = LOSSES[name](renderer(field, regions), image)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            losses.append(float(loss.detach()))
        assert losses[-1] < 0.6 * losses[0]

    def test_two_fields_in_one_image(self) -> None:
        """A sum of two renders under one optimizer."""
        image, renderer = target(), RegionSplatRenderer(keepdim=False)
        fields = [GaussianField.random(30, SIZE, seed=seed) for seed in range(2)]
        optimizer = GaussianAdam(fields)
        losses = []
        for _ in range(50):
            loss = (renderer(fields[0]) + renderer(fields[1]) - image).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(float(loss.detach()))
        assert losses[-1] < 0.2 * losses[0]


class TestInvalidFields:
    @pytest.mark.parametrize("backend", ["auto", "tiled", "reference"])
    @pytest.mark.parametrize(
        ("name", "value", "words"),
        [
            (
                "cholesky",
                -0.5,
                r"cholesky must be finite, l11 and l22 in .* pixels and .*; got l11 and l22 in \[-0.5, ",
            ),
            ("means", float("nan"), "means must be finite, .*; got 1 NaN or infinite values"),
            ("colors", float("inf"), "colors must be finite; got 1 NaN or infinite values"),
        ],
    )
    def test_one_error_that_says_what_helps(self, backend: str, name: str, value: float, words: str) -> None:
        """A step of another optimizer made it so: one exception, without another behind it."""
        field = initial_field(target(), 10)
        getattr(field, name).data[0, 0] = value
        with pytest.raises(ValueError, match=words + ".*GaussianAdam keeps a field valid") as error:
            RegionSplatRenderer(backend=backend)(field)
        assert error.value.__cause__ is None and error.value.__context__ is None
