"""A fit of a loss of the user's, and other objects of one's own in place of names."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, fit
from kcgs.fitting import initial_field, lowest_impact, propose_gaussians
from kcgs.fitting.problem import make_problem
from kcgs.fitting.state import FitState
from kcgs.functional import psnr
from kcgs.optim import GaussianAdam
from kcgs.rate import fit_bytes
from kcgs.video import fit_video

LABELS = (torch.arange(40) > 17).long().expand(32, 40)


def image() -> Tensor:
    y, x = torch.meshgrid(torch.arange(32.0), torch.arange(40.0), indexing="ij")
    return torch.stack([(0.3 * x).sin(), (0.2 * y).cos(), (0.1 * x * y).sin()]).mul(0.4).add(0.5)


def l1(render: Tensor) -> Tensor:
    assert render.shape == (1, 3, 32, 40)
    return (render - image()).abs().mean()


def squared(render: Tensor) -> Tensor:
    return (render - image()).square().mean()


class OldEvent:
    """An event of version 0.3, which would act at every iteration."""

    def due(self, state: FitState) -> float:
        return 0.5

    def act(self, state: FitState) -> None: ...


class TestLoss:
    def test_l1_is_the_loss_of_that_name(self) -> None:
        own, named = (fit(image(), LABELS, 60, iterations=80, objective=objective) for objective in (l1, "l1"))
        assert max(e.psnr for e in own.history) > max(e.psnr for e in named.history) - 0.3
        assert own.history[-1].loss == pytest.approx(named.history[-1].loss, rel=0.1)
        best = min(entry.loss for entry in own.history[-20:])
        assert float(l1(own.scene()[None]).detach()) == pytest.approx(best, rel=0.02)

    def test_without_an_image_the_loss_says_where_gaussians_are_added(self) -> None:
        regions = RegionMap(LABELS, 0.5)
        result = fit(None, regions, 60, iterations=100, objective=squared, size=(32, 40))
        assert result.scene.num_gaussians > 40 and math.isnan(result.history[-1].psnr)
        assert float(psnr(result.scene().detach(), image())) > 18 and result.scene.regions.num_regions == 2
        assert torch.equal(result.scene.regions.labels, LABELS)

    def test_channels(self) -> None:
        target = image()[:1]
        result = fit(
            None, None, 20, iterations=40, objective=lambda r: (r - target).square().mean(), size=(32, 40), channels=1
        )
        assert result.scene().shape == (1, 32, 40) and result.history[-1].loss < 0.5 * result.history[0].loss

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"checkpoint": "state"}, "checkpoint must be None with objective of your own, which no file keeps"),
            ({"objective": lambda render: render.mean((2, 3))}, r"objective must be a function that returns a scalar"),
            (
                {"objective": lambda render: render.detach().mean()},
                "objective must be a loss that depends on the render",
            ),
            ({"image": None}, r"size must be \(height, width\) without an image; got None"),
            ({"image": None, "size": (32, 40), "target_psnr": 20.0}, "target_psnr must be None without an image"),
            ({"size": (32, 40)}, "size must be None with an image"),
            (
                {"image": None, "objective": "l2", "size": (32, 40)},
                "image must be given, unless objective is a loss of your own; got None",
            ),
            ({"objective": 3}, "objective must be a name or a function; got 3"),
            ({"densify": OldEvent()}, "densify must be an event without `due`, whose `act` knows when it acts; got "),
            (
                {"objective": lambda render: render.mean() * math.nan},
                "objective must be a number at the first Gaussians",
            ),
            ({"densify": 3}, "densify must be an event with `act` and `end`, or None: matching pursuit; got 3"),
            ({"initializer": 3}, "initializer must be a name or a function; got 3"),
            ({"bounded": True, "optimizer": GaussianAdam}, "bounded must be False with an optimizer of your own"),
        ],
    )
    def test_bad_arguments(self, change: dict[str, Any], words: str) -> None:
        with pytest.raises(ValueError, match=words):
            fit(**{"image": image(), "num_gaussians": 5, "objective": l1, "iterations": 3, **change})

    def test_the_loss_of_the_history_is_the_value_of_the_objective(self) -> None:
        for objective in ("l2", "l1", "ms-ssim"):
            result = fit(image(), None, 40, iterations=30, objective=objective, prune=0.0)
            problem = make_problem(image(), None, 40, result.config, 0)
            value = float(problem.objective.value(result.scene().detach()[None]))
            assert min(entry.loss for entry in result.history) == pytest.approx(value, rel=1e-4)

    @pytest.mark.parametrize(
        ("objective", "words"),
        [
            (l1, "objective must be one of .*; got a function, which only kcgs.fit takes"),
            ("l1", "objective must be (ms-ssim or l2 for a file of a size|l2 or ms-ssim for a video); got 'l1'"),
        ],
    )
    def test_files_and_videos_lower_what_they_can(self, objective: Any, words: str) -> None:
        with pytest.raises(ValueError, match=words):
            fit_bytes(image(), None, 300, objective=objective)
        with pytest.raises(ValueError, match=words):
            fit_video([image()], objective=objective)


@dataclass(frozen=True)
class AddAll:
    """Adds all Gaussians at the middle of a fit."""

    end: float = 0.5

    def act(self, state: FitState) -> None:
        if state.num_additions or state.progress < self.end:
            return
        state.num_additions += 1
        error = state.problem.image - state.render().detach()
        state.optimizer.append(state.field, propose_gaussians(error, 30, state.regions))


def test_an_event_and_an_optimizer_of_ones_own(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"densify": AddAll(), "optimizer": lambda field: GaussianAdam(field, 0.05)}
    counts: list[int] = []
    result = fit(image(), LABELS, 60, iterations=60, on_step=lambda i, e: counts.append(e.num_gaussians), **settings)
    assert counts[28] == 2 and counts[-1] == 32 and result.history[-1].psnr > result.history[0].psnr + 5
    with pytest.raises(ValueError, match="checkpoint must be None with densify of your own"):
        fit(image(), LABELS, 60, checkpoint=tmp_path / "state", **settings)


# maps of a batch with other numbers of regions
MAPS = torch.stack([LABELS, torch.arange(1280).view(32, 40) // 160])


@pytest.mark.parametrize(("num_images", "regions"), [(1, LABELS), (2, MAPS), (2, None)])
def test_first_gaussians_of_ones_own(num_images: int, regions: Tensor | None) -> None:
    images = torch.stack([image(), image().flip(1)])[:num_images]
    maps = MAPS[:num_images] if regions is MAPS else regions
    named, own = (fit(images, maps, 40, iterations=20, initializer=value).scene for value in (None, initial_field))
    for name in ("means", "cholesky", "colors"):
        assert torch.equal(getattr(own.field, name), getattr(named.field, name))


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (None, "NoneType"),
        (GaussianField.random(3, (32, 40), seed=0), r"colors \(3, 3\), size \(32, 40\) and no region_ids"),
        (initial_field(image()[None], 3, LABELS), r"colors \(1, 3, 3\), size \(32, 40\) and region_ids"),
    ],
)
def test_first_gaussians_that_do_not_fit(field: object, words: str) -> None:
    expected = r"a GaussianField of colors \(1, 1, 3\), size \(32, 40\) and no region_ids"
    with pytest.raises(ValueError, match=f"^initializer must be a function that returns {expected}; got {words}$"):
        fit(image(), None, 60, initializer=lambda *arguments: field)


def faint(images: Tensor, count: int, *arguments: object) -> GaussianField:
    """Return first Gaussians with opacities."""
    first = initial_field(images, count)
    opacities = torch.full((len(images), count), 0.5)
    return GaussianField(first.means, first.cholesky, first.colors, None, opacities, size=first.size)


def test_first_gaussians_with_opacities() -> None:
    def merged(*arguments: Any) -> GaussianField:
        return faint(*arguments).without_opacities()

    first, second = (fit(image(), None, 40, iterations=20, initializer=value).scene.field for value in (faint, merged))
    assert torch.equal(first.colors, second.colors) and first.opacities is None


class ExactAdam(GaussianAdam):
    """Declines drafts, and keeps its rates."""

    has_drafts = False

    def rate(self, progress: float) -> float:
        return 1.0


def test_an_optimizer_that_declines_drafts() -> None:
    cutoffs, rates = [], []

    class Observe(AddAll):
        def act(self, state: FitState) -> None:
            cutoffs.append(state.renderer.cutoff)
            rates.append(state.optimizer.param_groups[0]["lr"])

    for optimizer in (ExactAdam, GaussianAdam):
        fit(image(), None, 20, iterations=20, densify=Observe(), optimizer=optimizer)
    assert set(cutoffs[:20]) == {1e-4} and set(cutoffs[20:37]) == {1e-3} and set(cutoffs[37:]) == {1e-4}
    assert set(rates[:20]) == {0.14} and rates[39] < 0.02


def test_an_optimizer_that_keeps_no_averages_is_not_gone_on_with() -> None:
    class StartsAnew(GaussianAdam):
        keeps_averages = False

    firsts = []
    for optimizer in (GaussianAdam, StartsAnew):
        iterations: list[int] = []
        fit(image(), None, 60, iterations=40, target_psnr=20.0, optimizer=optimizer,
            on_step=lambda i, e, seen=iterations: seen.append(i))  # fmt: skip
        firsts.append([i for k, i in enumerate(iterations) if k and i <= iterations[k - 1]])
    assert set(firsts[0]) == {25} and set(firsts[1]) == {1}


def test_an_optimizer_without_a_rate() -> None:
    words = "an optimizer with param_groups, .*; got Adam without has_drafts, keeps_averages, rate, append, keep"
    for images, more in ((image(), ""), (torch.stack([image()] * 2), ", freeze, frozen_rows")):
        with pytest.raises(ValueError, match=f"^optimizer must be a function that returns {words}{more}$"):
            fit(images, None, 9, optimizer=lambda field: torch.optim.Adam(field.parameters()))


def test_an_optimizer_for_one_image_freezes_no_rows() -> None:
    class Adam:
        def __init__(self, field: GaussianField) -> None:
            self._adam = GaussianAdam(field)

        def __getattr__(self, name: str) -> Any:
            if name in ("freeze", "frozen_rows"):
                raise AttributeError(name)
            return getattr(self._adam, name)

    own, named = (fit(image(), LABELS, 30, iterations=40, optimizer=value) for value in (Adam, None))
    assert torch.equal(own.scene.render(), named.scene.render())


def test_an_event_that_adds_too_many_and_one_that_ends_the_fit() -> None:
    class AddTooMany(AddAll):
        def act(self, state: FitState) -> str | None:
            if state.num_additions == 0:
                state.num_additions, error = 1, image() - state.render().detach()
                state.optimizer.append(state.field, propose_gaussians(error, 30, state.regions))
            return "enough" if state.iteration == 9 else None

    result = fit(image(), LABELS, 8, iterations=30, on_step=lambda i, e: False, densify=AddTooMany())
    assert result.stop_reason == "enough" and 0 < result.scene.num_gaussians <= 8


class TestLoop:
    """The two steps of a loop of one's own."""

    def test_additions_and_removals(self) -> None:
        field, renderer = initial_field(image(), 6, LABELS), RegionSplatRenderer()
        optimizer, values = GaussianAdam(field), []
        for step in range(60):
            if step % 10 == 5:
                mask, colors = lowest_impact(field, max(0, field.num_gaussians - 40), LABELS)
                field.colors.data = colors
                optimizer.keep(field, ~mask)
                error = image() - renderer(field, LABELS).detach()
                optimizer.append(field, propose_gaussians(error, 12, LABELS))
            optimizer.zero_grad()
            values.append(l1(renderer(field, LABELS)[None]))
            values[-1].backward()
            optimizer.step()
        assert field.num_gaussians <= 52 and values[-1] < 0.35 * values[4]

    def test_half_precision(self) -> None:
        assert propose_gaussians((image() - 0.5).bfloat16(), 5).num_gaussians == 5

    @pytest.mark.parametrize(
        ("call", "error", "words"),
        [
            (lambda: propose_gaussians(image()[0], 3), ValueError, "error must have 3 or 4 dimensions"),
            (lambda: propose_gaussians(image().expand(2, 3, 32, 40), 3, LABELS.expand(3, -1, -1)), ValueError,
             "one for each of 2 images"),
            (lambda: propose_gaussians(image() / 0, 3), ValueError, "error must be finite"),
            (lambda: propose_gaussians(image(), 0), ValueError, "num_gaussians must be at least 1; got 0"),
            (lambda: propose_gaussians(image(), 3, LABELS[1:]), ValueError, "regions must be one map of the image's"),
            (lambda: lowest_impact(3, 3), TypeError, "field must be a GaussianField; got int"),
            (lambda: lowest_impact(initial_field(image(), 5), 6), ValueError, r"num_gaussians must be in \[0, 5\]"),
            (lambda: lowest_impact(faint(image()[None], 5), 3), ValueError, "field must be without opacities"),
            (lambda: lowest_impact(initial_field(image(), 5, LABELS), 3), ValueError,
             "regions must be given where the field has region ids"),
            (lambda: lowest_impact(initial_field(image(), 5), 3, LABELS), ValueError,
             "regions must be given where the field has region ids"),
        ],
    )  # fmt: skip
    def test_bad_arguments(self, call: Callable[[], object], error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            call()
