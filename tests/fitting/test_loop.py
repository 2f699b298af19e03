"""The fit: convergence, switches, stopping, determinism, bad input."""

from __future__ import annotations

import json
import math
import tomllib
from functools import partial
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from kcgs import FitConfig, GaussianField, RegionMap, fit
from kcgs.data import chart_2x3
from kcgs.fitting import available_recipes
from kcgs.fitting.events import Warmup, contours
from kcgs.fitting.gaussian_image import GaussianImageAdan
from kcgs.fitting.problem import make_problem
from kcgs.fitting.start import start
from kcgs.functional import ef_psnr, psnr
from kcgs.optim import Renderer
from tests.conftest import Clock


def disc(size: tuple[int, int] = (32, 40)) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    labels = ((x - 20) ** 2 + (y - 16) ** 2 < 100).long()
    image = torch.where(labels.bool(), torch.tensor([0.9, 0.3, 0.1])[:, None, None], 0.2)
    return image, labels


def quick(recipe: str = "paper", **settings: object) -> FitConfig:
    return FitConfig.from_recipe(recipe, **{"iterations": 60, **settings})


class TestResult:
    def test_history(self) -> None:
        image, labels = disc()
        history = fit(image, labels, 12, recipe=quick(iterations=200)).history
        assert [h.iteration for h in history] == [*range(0, 200, 2), 200]
        assert all(b.seconds >= a.seconds for a, b in pairwise(history))
        assert history[-1].psnr > history[0].psnr + 3
        assert all(math.isfinite(h.ef_psnr) and h.num_gaussians == 12 for h in history)

    def test_ef_psnr_agrees_with_the_metric(self) -> None:
        image, labels = disc()
        result = fit(image, labels, 12, recipe=quick())
        best = max(result.history, key=lambda h: h.psnr)
        assert float(ef_psnr(result.scene.render(), image, labels)) == pytest.approx(best.ef_psnr, abs=1e-3)

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
    def test_inside_no_grad(self, mode: type) -> None:
        image, labels = disc()
        want = fit(image, labels, 5, recipe=quick(iterations=5))
        with mode():
            got = fit(image.clone(), labels.clone(), 5, recipe=quick(iterations=5))
        assert torch.equal(got.scene.field.means, want.scene.field.means)

    def test_input_is_not_changed(self) -> None:
        image, labels = disc()
        copies = image.clone(), labels.clone()
        fit(image, labels, 5, recipe=quick(iterations=5))
        assert torch.equal(image, copies[0]) and torch.equal(labels, copies[1])

    @pytest.mark.parametrize("size", [(1, 1), (7, 3)])
    def test_smaller_than_a_tile(self, size: tuple[int, int]) -> None:
        result = fit(torch.full((3, *size), 0.5), None, min(3, size[0] * size[1]), recipe=quick(iterations=100))
        assert result.history[-1].psnr > 20


class TestSettings:
    def test_recipes(self) -> None:
        published = {"paper", "gaussian-image", "gaussian-image-clamp"}
        assert set(available_recipes()) == {"best", "best-baseline", "best-refined", *published}

    def test_the_defaults_are_the_recipe_best(self) -> None:
        image, labels = disc()
        assert FitConfig() == FitConfig.from_recipe("best")
        assert fit(image, labels, 5, iterations=1).config == FitConfig(iterations=1, objective="l2")

    def test_a_recipe_by_name_or_whole_and_settings_over_it(self) -> None:
        image, labels = disc()
        named = fit(image, labels, 5, recipe="paper", iterations=7, softness=0.7)
        whole = fit(image, labels, 5, recipe=FitConfig.from_recipe("paper", softness=0.7), iterations=7)
        assert named.config == whole.config == FitConfig.from_recipe("paper", iterations=7, softness=0.7)
        assert torch.equal(named.scene.field.means, whole.scene.field.means)
        with pytest.raises(ValueError, match="^unknown setting 'iteration': did you mean iterations\\?$"):
            fit(image, labels, 5, iteration=7)
        with pytest.raises(TypeError, match="recipe must be a name or a FitConfig; got dict"):
            fit(image, labels, 5, recipe={})  # type: ignore[arg-type]

    @pytest.mark.parametrize("recipe", available_recipes())
    def test_all_values_are_plain(self, recipe: str) -> None:
        """Settings go through JSON and TOML and back, and so does a fit's whole config."""
        image, labels = disc()
        for config in (quick(recipe), fit(image, labels, 5, recipe=quick(recipe, iterations=1)).config):
            toml = "\n".join(f"{k} = {json.dumps(v)}" for k, v in config.model_dump(exclude_none=True).items())
            assert FitConfig(**tomllib.loads(toml)) == config
            assert FitConfig.model_validate_json(config.model_dump_json()) == config

    def test_one_image_takes_a_batch_of_one_map(self) -> None:
        image, labels = disc()
        regions = RegionMap(labels[None], {(0, 1): 0.5})
        want = fit(image, labels, 5, recipe=quick(softness=0.5, iterations=5)).scene
        got = fit(image, regions, 5, recipe=quick(iterations=5)).scene
        assert torch.equal(got.field.means, want.field.means)
        assert torch.equal(got.regions.labels, labels)  # type: ignore[union-attr]


class TestSwitches:
    def test_warmup_moves_ids_and_no_warmup_freezes_them(self) -> None:
        image, labels = disc()
        start = fit(image, labels, 60, recipe=quick(iterations=1, warmup=False)).scene.field.region_ids
        frozen = fit(image, labels, 60, recipe=quick(warmup=False)).scene.field
        assert torch.equal(frozen.region_ids, start)
        moved = fit(image, labels, 60, recipe=quick(iterations=100)).scene.field
        assert not torch.equal(moved.region_ids, start)

    def test_clamp_of_saturated_pictures(self) -> None:
        image, labels = disc()
        for picture, is_saturated in ((image.clamp(0.1, 0.9), False), ((image > 0.5).float(), True)):
            auto, free = (fit(picture, labels, 8, recipe=quick(clamp=c)).scene.field.colors for c in ("auto", False))
            assert torch.equal(auto, free) != is_saturated

    def test_values_overshoot_only_where_the_image_is_saturated(self) -> None:
        image = torch.tensor([0.0, 1.0, 0.5, 0.5]).expand(1, 6, 4)
        values = torch.tensor([2.0, -1.0]).view(2, 1, 1, 1).expand(2, 1, 6, 4)
        for clamp, clipped in (
            (True, [[1.0] * 4, [0.0] * 4]),
            ("auto", [[2.0, 1.0, 2.0, 2.0], [0.0, -1.0, -1.0, -1.0]]),
        ):
            bounds = make_problem(image, None, 1, FitConfig(clamp=clamp), 0).bounds
            assert bounds is not None and values.clamp(*bounds)[:, 0, 5].tolist() == clipped
        assert make_problem(image, None, 1, FitConfig(clamp=False), 0).bounds is None

    def test_softness_of_the_map_or_the_recipe(self) -> None:
        image, labels = disc()
        recipe = quick(iterations=1, softness=0.7)
        assert fit(image, RegionMap(labels, 0.9), 5, recipe=recipe).scene.regions.softness == 0.9
        assert fit(image, labels, 5, recipe=recipe).scene.regions.softness == 0.7

    @pytest.mark.parametrize("settings", [{"objective": "ms-ssim"}, {"recipe": "paper"}, {"objective": "l1"}])
    def test_the_psnr_is_that_of_the_scene(self, settings: dict[str, str]) -> None:
        image, labels = disc()
        result = fit(image, labels, 12, iterations=60, prune=0.0, **settings)
        assert float(psnr(result.scene.render(), image)) == pytest.approx(result.psnr, abs=1e-3)

    def test_warmup_leaves_no_region_without_its_last_gaussian(self) -> None:
        image, labels = disc()
        state = start(make_problem(image, labels, 2, quick(), 0))
        first = state.field.region_ids.clone()
        assert sorted(first[0].tolist()) == [0, 1]
        state.field.means.data[:] = torch.tensor([20.0, 16.0])  # all are under label 1
        state.iteration = 1
        Warmup().act(state)
        assert sorted(state.field.region_ids[0].tolist()) == [0, 1]

    def test_the_map_of_tanh_and_signs_of_gaussian_image(self) -> None:
        """A factor whose column has changed its sign is the same Gaussian."""
        field = GaussianField.random(9, (20, 30), seed=0)
        optimizer = GaussianImageAdan(field, 2.0, 100, 1.0)
        expected = [tensor.detach().clone() for tensor in (field.means, field.cholesky, field.colors)]
        with torch.no_grad():
            optimizer.parameters[1][:, :2] *= -1
        means, cholesky, colors = optimizer.decode()
        torch.testing.assert_close([means, cholesky, colors], expected)


class TestStopping:
    def test_compilation_takes_none_of_the_time(self, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcgs.fitting.loop.precompile", lambda config, device: clock.advance(100.0))
        result = fit(*disc(), 12, recipe=quick(iterations=10**7, max_seconds=0.5))
        assert result.stop_reason == "seconds" and clock.seconds > 100 and 0.4 < result.seconds < 0.6

    @pytest.mark.parametrize(("seconds", "is_moved"), [(0.2, True), (1.0, False)])
    def test_contours_keep_to_their_share_of_the_clock(
        self, clock: Clock, monkeypatch: pytest.MonkeyPatch, seconds: float, is_moved: bool
    ) -> None:
        """Of 3 seconds moves take 0.75 at most: they are left out where the first would take more."""
        moves = []

        def move(gaussians: object, renderer: Renderer, *_: object) -> RegionMap:
            moves.append(seconds)
            clock.advance(seconds)
            assert renderer.regions is not None
            return renderer.regions

        image, labels = disc()
        monkeypatch.setattr("kcgs.fitting.loop.precompile", lambda config, device: None)
        monkeypatch.setattr(contours, "move_contours", move)
        monkeypatch.setattr(contours, "_SECONDS_PER_PIXEL", seconds / labels.numel())
        result = fit(image, labels, 12, recipe="best", iterations=10**7, max_seconds=3.0)
        assert result.stop_reason == "seconds" and bool(moves) == is_moved and sum(moves) <= 0.75

    def test_never_ends_below_the_best(self) -> None:
        image, labels = disc()
        result = fit(image, labels, 12, recipe=quick(learning_rate_factor=1000.0))
        picture = result.scene.render()
        assert float(psnr(picture, image)) >= max(h.psnr for h in result.history) - 0.01


def test_paper_beats_both_baselines() -> None:
    """The paper's first experiment in short: 20 Gaussians, guidance far ahead of the baseline at contours."""
    image, labels = (part[..., ::4, ::4] for part in chart_2x3())
    best = {}
    for recipe in ("paper", "gaussian-image", "gaussian-image-clamp"):
        history = fit(image, labels, 20, recipe=recipe, iterations=200).history
        best[recipe] = max(history, key=lambda h: h.psnr)
    for baseline in ("gaussian-image", "gaussian-image-clamp"):
        assert best["paper"].psnr > best[baseline].psnr + 5
        assert best["paper"].ef_psnr > best[baseline].ef_psnr + 5


class TestErrors:
    @pytest.mark.parametrize(
        ("change", "error", "words"),
        [
            ({"image": None}, TypeError, "image must be a Tensor"),
            ({"image": torch.zeros(4, 4)}, ValueError, "image must have 3 or 4 dimensions"),
            ({"image": torch.zeros(2, 5, 5, 3)}, ValueError, r"image must be \(B, C, H, W\); .*\(B, H, W, C\)"),
            ({"image": torch.zeros(0, 3, 4, 4)}, ValueError, "image must not be empty"),
            (
                {"image": torch.full((3, 4, 4), 2.0)},
                ValueError,
                r"image must be in \[0, 1\]; got \[2, 2\]: divide it by 255",
            ),
            ({"image": torch.full((3, 4, 4), math.nan)}, ValueError, "image must be finite"),
            ({"image": torch.zeros(3, 4, 4, dtype=torch.uint8)}, TypeError, "got torch.uint8: pass image / 255"),
            ({"regions": torch.zeros(5, 4).long()}, ValueError, "regions must be one map of the image's size"),
            ({"regions": 3}, TypeError, "regions must be a RegionMap"),
            ({"num_gaussians": 0}, ValueError, "num_gaussians must be at least 1; got 0"),
            ({"num_gaussians": 50}, ValueError, "num_gaussians must be at most 16, the pixels of the 4 x 4 image"),
            ({"num_gaussians": 2.5}, TypeError, "num_gaussians must be an integer; got 2.5"),
            ({"seed": "a"}, TypeError, "seed must be an integer; got 'a'"),
            ({"seed": -1}, ValueError, r"seed must be in \[0, 9223372036854775807\]; got -1"),
            ({"recipe": "best-ever"}, ValueError, "recipe must be one of .*paper.*; got 'best-ever'"),
        ],
    )
    def test_bad_input(self, change: dict[str, object], error: type[Exception], words: str) -> None:
        good = {"image": torch.zeros(3, 4, 4), "regions": None, "num_gaussians": 2}
        with pytest.raises(error, match=words):
            fit(**{**good, **change})

    @pytest.mark.parametrize(
        ("settings", "words"),
        [
            ({"speed": 5}, "^unknown setting 'speed': there are guidance, .*, target_psnr$"),
            ({"iterations": 0}, "iterations must be greater than or equal to 1; got 0"),
            ({"objective": "l3"}, "^objective must be one of l2, l1, ms-ssim; got 'l3'$"),
            ({"objective": abs}, "^objective must be .*; got a function, which only kcgs.fit takes$"),
            ({"objective": "l1+ssim"}, "^objective must be .*, which is now in benchmarks/core/"),
            ({"optimizer": object()}, "^optimizer must be 'gaussian-adam' or 'adan'; got "),
            ({"max_seconds": math.inf}, "max_seconds must be a finite number"),
            ({"backend": "gpu"}, "^backend must be one of auto, [^;]*; got 'gpu'$"),
        ],
    )
    def test_bad_settings(self, settings: dict[str, object], words: str) -> None:
        for make in (FitConfig, partial(FitConfig.from_recipe, "paper")):
            with pytest.raises(ValueError, match=words):
                make(**settings)


def test_same_bits_with_any_number_of_threads() -> None:
    image, labels = disc()
    before, renders = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            renders.append(fit(image, labels, 12, recipe=quick(iterations=20)).scene.render())
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert torch.equal(renders[0], renders[1]) and torch.equal(renders[0], renders[2])
