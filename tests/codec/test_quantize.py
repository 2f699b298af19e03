"""Rounding: how far it is off, and that it adds the error that it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kcgs.codec.gaussians.occupancy import Grid
from kcgs.codec.gaussians.quantize import Parameters, Quantizer, opponent
from kcgs.functional import region_splat

from .conftest import make_scene

Floats = np.ndarray


def arrays(count: int = 200, size: tuple[int, int] = (96, 144), seed: int = 0) -> Parameters:
    field = make_scene(count, size, 1, seed=seed).field
    return Parameters(*(t.detach().double().numpy() for t in (field.means, field.cholesky, field.colors)))


class TestRoundTrip:
    @pytest.mark.parametrize("qp", [-100, 200, 600])
    def test_within_half_a_step(self, qp: int) -> None:
        gaussians = means, cholesky, colors = arrays()
        quantizer = Quantizer(qp, (96, 144))
        classes = quantizer.classify(gaussians)
        steps = quantizer.steps(classes)
        codes = quantizer.quantize(gaussians, classes)
        found_means, found, found_colors = (t.astype(np.float64) for t in quantizer.restore(codes))
        assert (np.abs(opponent(found_colors - colors)) <= (0.5 + 1e-4) * steps.color[:, None] + 1e-6).all()
        scale, before = (0.5 * np.log2(t[:, 0] * t[:, 2]) for t in (found, cholesky))
        assert (np.abs(scale - before) <= 0.75 * (0.5 + 1e-4) / steps.scales + 1e-6).all()
        # the centre is right to half a place across, and down where it counts: across the slant
        across, down = (steps.side[:, None] / steps.places(found)).T
        off = found_means - means
        slanted = off[:, 1] - found[:, 1] / found[:, 0] * off[:, 0]
        assert (np.abs(off[:, 0]) <= (0.5 + 1e-4) * across + 1e-4).all()
        assert (np.abs(slanted) <= (0.5 + 1e-4) * down + 1e-3).all()

    def test_finer_is_nearer(self) -> None:
        gaussians = means, cholesky, colors = arrays()
        # those that the eye would find again
        strong = np.sqrt((colors**2).sum(1) * cholesky[:, 0] * cholesky[:, 2]) > 1
        errors = []
        for qp in (0, 200, 400, 800):
            quantizer = Quantizer(qp, (96, 144))
            codes = quantizer.quantize(gaussians, quantizer.classify(gaussians))
            errors.append(np.abs(quantizer.restore(codes)[0] - means)[strong].max())
        assert errors == sorted(errors, reverse=True) and errors[-1] < 0.1 < errors[0]

    def test_rounding_twice_is_rounding_once(self) -> None:
        quantizer = Quantizer(300, (96, 144))
        gaussians = arrays()
        classes = quantizer.classify(gaussians)
        once = quantizer.quantize(gaussians, classes)
        again = quantizer.quantize(Parameters(*(t.astype(np.float64) for t in quantizer.restore(once))), classes)
        for name in ("scale", "ratio", "colors"):
            assert np.mean(getattr(once, name) == getattr(again, name)) > 0.999, name

    def test_far_outside_is_brought_nearer(self) -> None:
        quantizer = Quantizer(300, (96, 144))
        means = np.array([[-1e6, 50.0], [1e6, 1e6]])
        gaussians = Parameters(means, np.array([[2.0, 0.0, 2.0]] * 2), np.ones((2, 3)))
        codes = quantizer.quantize(gaussians, quantizer.classify(gaussians))
        found = quantizer.restore(codes)[0]
        grid = Grid.over((96, 144), 2)
        reach = grid.most_margin * grid.side
        assert (found >= -reach).all() and (found[1] <= np.array([144, 96]) + reach + 64).all()


class TestDistortion:
    def test_the_error_is_the_one_that_was_asked_for(self) -> None:
        # far apart and inside, so that errors do not meet
        size, generator = (320, 320), np.random.default_rng(0)
        grid = np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2)
        means = 40.0 * grid + 20 + generator.uniform(-2, 2, (64, 2))
        cholesky = np.stack(
            [generator.uniform(2, 5, 64), generator.uniform(-2, 2, 64), generator.uniform(2, 5, 64)], -1
        )
        colors = generator.uniform(0.3, 1.0, (64, 3))
        quantizer = Quantizer(200, size)
        total = 0.0
        for _ in range(6):
            moved = Parameters(means + generator.uniform(-0.5, 0.5, means.shape), cholesky, colors)
            codes = quantizer.quantize(moved, quantizer.classify(moved))
            renders = [
                region_splat(*(torch.from_numpy(np.asarray(t, np.float64)) for t in numbers), size=size, cutoff=0.0)
                for numbers in (moved, quantizer.restore(codes))
            ]
            total += float((renders[0] - renders[1]).square().sum())
        expected = 6 * 64 * 8 * quantizer.distortion
        assert 0.75 * expected < total < 1.25 * expected

    def test_classes_follow_energy(self) -> None:
        quantizer = Quantizer(300, (96, 144))
        cholesky = np.array([[2.0, 0.0, 2.0], [4.0, 0.0, 4.0]])
        colors = np.full((2, 3), 0.5)
        steps = quantizer.steps(quantizer.classify(Parameters(np.zeros((2, 2)), cholesky, colors)))
        assert math.isclose(steps.place[0] / steps.place[1], 2.0)  # twice the amplitude's square root of area
        assert steps.color[0] > steps.color[1]


def test_sides_of_cells() -> None:
    for count in (1, 7, 100, 5000, 10**6):
        side = Grid.over((480, 854), count).side
        assert side == 1 or 16 <= 480 * 854 / (side * side * count) < 128
