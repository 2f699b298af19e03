"""Loops that people write around the renderer: GaussianAdam under losses of their own, and steps that fail."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kornia
import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionSplatRenderer
from kcgs.errors import InvalidArgument
from kcgs.fitting import initial_field
from kcgs.functional import region_splat
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


def feature_loss() -> Loss:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.GELU()).requires_grad_(False)
    return lambda render, image: (network(render) - network(image)).square().mean()


LOSSES: dict[str, Loss] = {
    "L1": lambda render, image: (render - image).abs().mean(),
    "SSIM": lambda render, image: kornia.losses.ssim_loss(render, image, window_size=5),
    "features": feature_loss(),
}


def descend(optimizer: GaussianAdam, error: Callable[[], Tensor], schedule: Any = None) -> list[float]:
    """Take fifty steps; return the losses."""
    losses = []
    for _ in range(50):
        loss = error()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if schedule is not None:
            schedule.step()
        losses.append(float(loss.detach()))
    return losses


class TestLossesFall:
    @pytest.mark.parametrize(("name", "kind"), [("L1", "one"), ("SSIM", "double"), ("features", "batch")])
    def test_in_fifty_steps(self, name: str, kind: str, device: torch.device) -> None:
        """At the default rate, with a schedule; the field is valid at every step, since the renderer takes it."""
        dtype = torch.float64 if kind == "double" else torch.float32
        image = target(2 if kind == "batch" else 1, dtype).to(device)
        regions = halves().to(device)
        field = initial_field(image, 40, regions)
        renderer = RegionSplatRenderer(keepdim=False, backend="tiled" if device.type == "cuda" else "auto")
        optimizer = GaussianAdam(field.to(device))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 50)
        losses = descend(optimizer, lambda: LOSSES[name](renderer(field, regions), image), schedule)
        assert losses[-1] < 0.6 * losses[0]

    def test_two_fields_in_one_image(self) -> None:
        """A sum of two renders under one optimizer."""
        image, renderer = target(), RegionSplatRenderer(keepdim=False)
        fields = [GaussianField.random(30, SIZE, seed=seed) for seed in range(2)]
        losses = descend(
            GaussianAdam(fields), lambda: (renderer(fields[0]) + renderer(fields[1]) - image).square().mean()
        )
        assert losses[-1] < 0.2 * losses[0]

    def test_lbfgs(self) -> None:
        """It flattens gradients by `view`: they have the strides of parameters, which are contiguous."""
        image, field, renderer = target(), initial_field(target(), 40), RegionSplatRenderer(keepdim=False)
        optimizer = torch.optim.LBFGS([field.colors], max_iter=10)

        def closure() -> Tensor:
            optimizer.zero_grad()
            loss = (renderer(field) - image).square().sum()
            loss.backward()
            return loss

        assert optimizer.step(closure) > 2 * closure()


def splat(means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
    return region_splat(means, cholesky, colors, size=SIZE).sum()


Gaussians = tuple[Tensor, Tensor, Tensor]
WAYS: dict[str, Callable[[Gaussians], object]] = {
    "auto": lambda gaussians: splat(*gaussians),
    "tiled": lambda gaussians: region_splat(*gaussians, size=SIZE, backend="tiled"),
    "torch.func.grad": lambda gaussians: torch.func.grad(splat)(*gaussians),
    "torch.compile": lambda gaussians: torch.compile(splat, fullgraph=True, backend="eager")(*gaussians),
}
SCALES = r"got l11 and l22 in \[-0.5, .*smaller learning rate, or kcgs.optim.GaussianAdam, which"


class TestInvalidFields:
    @pytest.mark.parametrize(
        ("way", "name", "value", "words"),
        [
            *((way, "cholesky", -0.5, SCALES) for way in WAYS),
            ("auto", "means", 1e9, r"got \[.*, 1e\+09\]. Where an optimizer's step made them so, take"),
            ("auto", "means", float("nan"), r"got \d NaN or infinite values. A loss or a gradient that is not finite"),
            ("auto", "colors", float("inf"), r"got \d NaN or infinite values. A loss or a gradient"),
        ],
    )
    def test_one_error_that_says_what_helps(self, way: str, name: str, value: float, words: str) -> None:
        """A step of another optimizer made it so: one exception, without another behind it."""
        field = initial_field(target(), 10)
        getattr(field, name).data[0, 0] = value
        with pytest.raises(InvalidArgument, match=f"^{name} must be .*{words}") as error:
            WAYS[way]((field.means, field.cholesky, field.colors))
        assert error.value.__cause__ is None and error.value.__context__ is None

    def test_a_loss_that_is_not_finite(self) -> None:
        """Nothing moves, and the loop may go on."""
        image, field, renderer = target(), initial_field(target(), 10), RegionSplatRenderer()
        before, optimizer = field.means.detach().clone(), GaussianAdam(field)
        for _ in range(2):
            optimizer.zero_grad()
            ((renderer(field) - image).square().mean() * float("nan")).backward()
            with pytest.raises(
                ValueError, match=r"gradients must be finite; got \d+ NaN or infinite values: the loss,"
            ):
                optimizer.step()
        assert torch.equal(field.means, before) and not optimizer.state


def test_a_warning_of_a_loop_names_its_line_and_shows_once() -> None:
    """However deep in torch it arises; Python's default filter compares the text and the line."""
    field, renderer = initial_field(target(), 10, halves()), RegionSplatRenderer()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(3):
            renderer(field, torch.zeros_like(halves())).sum().backward()
    assert [(Path(w.filename), "Gaussians paint nothing" in str(w.message)) for w in caught] == [(Path(__file__), True)]
