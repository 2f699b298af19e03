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
from torch.utils.checkpoint import checkpoint

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
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


def features() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.GELU(), nn.Conv2d(8, 8, 3, stride=2)).requires_grad_(False)


def feature_loss() -> Loss:
    network = features()
    return lambda render, image: (network.to(render)(render) - network.to(image)(image)).square().mean()


def edge_aware_smoothness(render: Tensor, image: Tensor) -> Tensor:
    """Penalise slopes of the rendered brightness except where the image has edges, together with the difference."""
    smooth = kornia.losses.inverse_depth_smoothness_loss(render.mean(1, keepdim=True), image)
    return smooth + (render - image).square().mean()


LOSSES: dict[str, Loss] = {
    "squared error": lambda render, image: (render - image).square().mean(),
    "L1": lambda render, image: (render - image).abs().mean(),
    "SSIM": lambda render, image: kornia.losses.ssim_loss(render, image, window_size=5),
    "features": feature_loss(),
    "Sobel": lambda render, image: (kornia.filters.sobel(render) - kornia.filters.sobel(image)).abs().mean(),
    "Laplacian": lambda render, image: (
        (kornia.filters.laplacian(render, 5) - kornia.filters.laplacian(image, 5)).abs().mean()
    ),
    "edge-aware smoothness": edge_aware_smoothness,
    "L1 and total variation": lambda render, image: (
        (render - image).abs().mean() + 0.02 * kornia.losses.total_variation(render, reduction="mean").mean()
    ),
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
    @pytest.mark.parametrize(
        ("name", "kind"), [*((name, "one") for name in LOSSES), ("SSIM", "double"), ("L1", "batch"), ("SSIM", "tiled")]
    )
    def test_in_fifty_steps(self, name: str, kind: str, device: torch.device) -> None:
        """At the default rate, with a schedule; the field is valid at every step, since the renderer takes it."""
        dtype = torch.float64 if kind == "double" else torch.float32
        image = target(2 if kind == "batch" else 1, dtype).to(device)
        regions = halves().to(device)
        field = initial_field(image, 40, regions)
        tiled = kind == "tiled" or device.type == "cuda"
        renderer = RegionSplatRenderer(keepdim=False, backend="tiled" if tiled else "auto")
        optimizer = GaussianAdam(field.to(device))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 50)
        losses = descend(optimizer, lambda: LOSSES[name](renderer(field, regions), image), schedule)
        assert losses[-1] < 0.6 * losses[0]

    @pytest.mark.parametrize("name", LOSSES)
    def test_gradients_are_finite_where_the_image_is_flat(self, name: str) -> None:
        """A black image has no slope anywhere: roots of zero must not show."""
        field = initial_field(target(), 40, halves())
        field.colors.data.zero_()
        LOSSES[name](RegionSplatRenderer(keepdim=False)(field, halves()), target()).backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in field.parameters())

    def test_two_fields_in_one_image(self) -> None:
        """A sum of two renders under one optimizer."""
        image, renderer = target(), RegionSplatRenderer(keepdim=False)
        fields = [GaussianField.random(30, SIZE, seed=seed) for seed in range(2)]
        losses = descend(
            GaussianAdam(fields), lambda: (renderer(fields[0]) + renderer(fields[1]) - image).square().mean()
        )
        assert losses[-1] < 0.2 * losses[0]

    def test_compiled_with_its_loss(self) -> None:
        """One graph of render and loss, with a map that has soft contours."""
        image, field, renderer = target(), initial_field(target(), 40, halves()), RegionSplatRenderer(keepdim=False)
        regions = RegionMap(halves(), softness=0.7)
        error = torch.compile(lambda: LOSSES["L1"](renderer(field, regions), image), fullgraph=True, backend="eager")
        losses = descend(GaussianAdam(field), error)
        assert losses[-1] < 0.6 * losses[0]

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
    "reference": lambda gaussians: region_splat(*gaussians, size=SIZE, backend="reference"),
    "float64": lambda gaussians: splat(*(t.double() for t in gaussians)),
    "batch": lambda gaussians: splat(*(t.expand(3, -1, -1) for t in gaussians)),
    "torch.func.grad": lambda gaussians: torch.func.grad(splat)(*gaussians),
    "torch.func.vmap": lambda gaussians: torch.func.vmap(splat)(*(t.expand(3, -1, -1) for t in gaussians)),
    "checkpoint": lambda gaussians: checkpoint(splat, *gaussians, use_reentrant=False),
    "torch.compile": lambda gaussians: torch.compile(splat, fullgraph=True, backend="eager")(*gaussians),
}


class TestInvalidFields:
    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize(
        ("name", "value", "words"),
        [
            (
                "cholesky",
                -0.5,
                r"got l11 and l22 in \[-0.5, .*smaller learning rate, or kcgs.optim.GaussianAdam, which",
            ),
            ("means", 1e9, r"got \[.*, 1e\+09\]. Where an optimizer's step made them so, take a smaller learning rate"),
            ("means", float("nan"), r"got \d NaN or infinite values. A loss or a gradient that is not finite"),
            ("colors", float("inf"), r"got \d NaN or infinite values. A loss or a gradient"),
        ],
    )
    def test_one_error_that_says_what_helps(self, way: str, name: str, value: float, words: str) -> None:
        """A step of another optimizer made it so: one exception, without another behind it."""
        field = initial_field(target(), 10)
        getattr(field, name).data[0, 0] = value
        with pytest.raises(InvalidArgument, match=f"^{name} must be .*{words}") as error:
            WAYS[way]((field.means, field.cholesky, field.colors))
        assert error.value.__cause__ is None and error.value.__context__ is None

    @pytest.mark.parametrize("factor", [float("nan"), float("inf")])
    def test_a_loss_that_is_not_finite(self, factor: float) -> None:
        """Nothing moves, and the loop may go on."""
        image, field, renderer = target(), initial_field(target(), 10), RegionSplatRenderer()
        before, optimizer = field.means.detach().clone(), GaussianAdam(field)
        for _ in range(2):
            optimizer.zero_grad()
            ((renderer(field) - image).square().mean() * factor).backward()
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
