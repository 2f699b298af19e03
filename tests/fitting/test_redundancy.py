"""Which Gaussians are removed, against dense sums and least squares in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kcgs import fit
from kcgs.fitting.pursuit_loops import choose
from kcgs.fitting.redundancy import NEIGHBORS, lowest_impact
from kcgs.functional import psnr


def make(count: int, seed: int = 0, regions: int = 1) -> tuple[NDArray[np.float64], ...]:
    rng = np.random.default_rng(seed)
    means = rng.uniform(10, 30, (count, 2))
    cholesky = np.stack([rng.uniform(1.5, 3, count), rng.uniform(-1, 1, count), rng.uniform(1.5, 3, count)], -1)
    return means, cholesky, rng.normal(size=(count, 3)), rng.integers(0, regions, count)


def sampled(means: NDArray[np.float64], cholesky: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values on a grid that is fine and wide enough to integrate, (N, pixels)."""
    y, x = np.mgrid[-10:50:0.5, -10:50:0.5]
    dx, dy = (axis.ravel() - means[:, k, None] for k, axis in enumerate((x, y)))
    l11, l21, l22 = (column[:, None] for column in cholesky.T)
    first = dx / l11
    second = (dy - l21 * first) / l22
    return np.exp(-0.5 * (first**2 + second**2)) * 0.5


def cheapest(g: NDArray[np.float64], colors: NDArray[np.float64], region: NDArray[np.int64]) -> int:
    """The Gaussian whose loss is least once the others of its region are given the best colours."""
    costs = []
    for i in range(len(g)):
        others = g[(region == region[i]) & (np.arange(len(g)) != i)].T
        taken = others @ np.linalg.lstsq(others, g[i], rcond=None)[0] if others.size else 0.0
        costs.append(np.square(g[i] - taken).sum() * np.square(colors[i]).sum())
    return int(np.argmin(costs))


@pytest.mark.parametrize("seed", range(8))
def test_the_lowest_impact_goes(seed: int) -> None:
    means, cholesky, colors, region = make(12, seed, regions=2)
    g = sampled(means, cholesky)
    removed, new_colors = lowest_impact(means, cholesky, colors, region, 1, np.ones(len(means)))
    assert np.flatnonzero(removed).tolist() == [cheapest(g, colors, region)]
    before, dropped, after = colors.T @ g, colors[~removed].T @ g[~removed], new_colors[~removed].T @ g[~removed]
    for r in set(region[removed]):  # what is left of the loss is what least squares leaves
        others = g[(region == r) & ~removed].T
        best = np.linalg.lstsq(others, (before - dropped).T, rcond=None)
        least = np.square((before - dropped).T - others @ best[0]).sum()
        assert least <= np.square(after - before).sum() <= 1.05 * least + 1e-3 * np.square(before - dropped).sum()


def test_neighbours_of_a_removed_one_stay() -> None:
    means, cholesky, colors, region = make(2)
    means[1], cholesky[1] = means[0], cholesky[0]  # twins: one is enough
    removed, new_colors = lowest_impact(means, cholesky, colors, region, 2, np.ones(len(means)))
    assert removed.sum() == 1
    np.testing.assert_allclose(new_colors[~removed][0], colors.sum(0), rtol=2e-3)


def test_other_regions_do_not_help() -> None:
    means, cholesky, colors, _ = make(2)
    means[1], cholesky[1] = means[0], cholesky[0]
    removed, new_colors = lowest_impact(means, cholesky, colors, np.array([0, 1]), 2, np.ones(2))
    assert removed.all()
    np.testing.assert_allclose(new_colors, colors)


@pytest.mark.parametrize("count", [0, 1, NEIGHBORS + 5])
def test_extremes_are_finite(count: int) -> None:
    means, cholesky, colors, region = make(max(count, 1))
    means[:], cholesky[0] = 15.0, (1e4, 0.0, 0.1)
    removed, new_colors = lowest_impact(
        means[:count], cholesky[:count], colors[:count], region[:count], count, np.ones(count)
    )
    assert len(removed) == count and np.isfinite(new_colors).all()


def test_pursuit_picks_as_the_plain_loop_does() -> None:
    rng = np.random.default_rng(3)
    count, channels, limits = 400, 3, {"floor": 1e-3, "overlap": 0.2, "reach": 3.0, "longest": 50.0}
    y = np.sort(rng.uniform(0, 60, count))
    x, square, norm = rng.uniform(0, 60, count), rng.uniform(1, 9, count), rng.uniform(3, 20, count)
    share = rng.normal(size=(count, channels))
    gain = np.square(share).sum(1)
    picked, expected = np.zeros(100, np.int64), []
    places = np.stack([x, y, y], -1)
    picked = picked[: choose(places, square, norm, share.copy(), gain.copy(), tuple(limits.values()), picked)]
    while len(expected) < 100 and gain.max() > limits["floor"]:
        best = int(gain.argmax())
        expected.append(best)
        far = limits["reach"] * math.sqrt(square[best] + square.max())
        near = (abs(y - y[best]) <= far) & (abs(x - x[best]) <= far) & (gain >= 0)
        both = square + square[best]
        like = np.maximum(np.sqrt(square * square[best]) / both, np.sqrt(norm * norm[best]) / (norm + norm[best]))
        overlap = 2 * like * np.exp(-0.5 * ((x - x[best]) ** 2 + (y - y[best]) ** 2) / both)
        share = np.where(near[:, None], share - overlap[:, None] * share[best], share)
        gain = np.where(near, np.where(overlap > limits["overlap"], -1.0, np.square(share).sum(1)), gain)
    assert picked.tolist() == expected


class TestFit:
    image = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))

    @pytest.mark.parametrize("stop", [8, 25, 33, 60])
    def test_no_state_has_more_than_n(self, stop: int) -> None:
        """Wherever a fit is stopped, there are no more Gaussians than asked for, and what is logged is what is kept."""
        result = fit(self.image, None, 50, iterations=60, on_step=lambda iteration, entry: iteration == stop, prune=0.0)
        assert result.scene.num_gaussians <= 50
        assert all(entry.num_gaussians <= 50 for entry in result.history)
        best = max(entry.psnr for entry in result.history if entry.num_gaussians == result.scene.num_gaussians)
        assert float(psnr(result.scene.render(), self.image)) >= best - 0.05

    def test_all_from_the_start_means_no_cycles(self) -> None:
        counts = []
        fit(self.image, None, 50, iterations=40, densify_from=1.0, on_step=lambda i, e: counts.append(e.num_gaussians))
        assert set(counts) == {50}
