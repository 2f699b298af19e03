"""The conventions of docs/concepts.md with values worked by hand: pixel centres, x before y, ranges, ids."""

from __future__ import annotations

import math

import kornia
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, Scene
from kcgs.functional import lookup_regions, psnr, region_splat
from tests.tester import BaseTester

# exp(-d^2 / 2) at a distance of 1 and 2 standard deviations
ONE, TWO = 0.60653066, 0.13533528


class TestFunctionalConventions:
    @pytest.fixture(autouse=True)
    def place(self, backend: str, device: torch.device, dtype: torch.dtype) -> None:
        self.backend, self.device, self.dtype = backend, device, dtype

    def render(self, mean: list[float], cholesky: list[float], size: tuple[int, int], color: float = 1.0) -> Tensor:
        tensors = [torch.tensor([row], device=self.device, dtype=self.dtype) for row in (mean, cholesky, [color])]
        return region_splat(*tensors, size=size, backend=self.backend)

    def assert_values(self, values: Tensor, expected: list[float] | list[list[float]]) -> None:
        BaseTester.assert_close(values, torch.tensor(expected, device=values.device, dtype=values.dtype))

    def test_convention_pixel_centres_are_at_halves(self) -> None:
        self.assert_values(self.render([2.5, 0.5], [1, 0, 1], (1, 5))[0], [[TWO, ONE, 1, ONE, TWO]])
        # a centre at 2 lies between pixels 1 and 2: exp(-1 / 8) at half a pixel
        self.assert_values(self.render([2.0, 0.5], [1, 0, 1], (1, 4))[0, :, 1:3], [[0.8824969, 0.8824969]])

    def test_convention_points_of_kornia_are_half_a_pixel_less(self) -> None:
        """Its grids have the centre of the first pixel at 0."""
        grid = kornia.geometry.create_meshgrid(2, 3, normalized_coordinates=False).flatten(0, 2)
        for k, (x, y) in enumerate(grid.tolist()):
            image = self.render([x + 0.5, y + 0.5], [0.1, 0, 0.1], (2, 3))
            self.assert_values(image.flatten(), [float(k == pixel) for pixel in range(6)])

    def test_convention_x_before_y_height_before_width(self) -> None:
        image = self.render([3.5, 1.5], [2, 0, 1], (3, 5))  # twice as wide in x
        assert image.shape == (1, 3, 5)
        self.assert_values(image[0, 1, 3:], [1, 0.8824969])
        self.assert_values(image[0, 1:, 3], [1, ONE])

    def test_convention_cholesky_is_lower_triangular(self) -> None:
        """L = [1 0; 1 1] leans to (1, 1): Sigma = [1 1; 1 2], and z = (dx, dy - dx)."""
        image = self.render([1.5, 1.5], [1, 1, 1], (3, 3))[0]
        self.assert_values(image[1:, 1:], [[1, math.exp(-1)], [ONE, ONE]])

    def test_convention_sums_are_not_clipped_renders_are(self) -> None:
        image = self.render([0.5, 0.5], [1, 0, 1], (1, 2), color=1.5)
        self.assert_values(image[0], [[1.5, 1.5 * ONE]])
        field = GaussianField(
            torch.tensor([[0.5, 0.5]]), torch.tensor([[1.0, 0, 1]]), torch.tensor([[1.5]]), size=(1, 2)
        )
        self.assert_values(Scene(field).render()[0], [[1, 1.5 * ONE]])
        # metrics clip first: 0.5 against 1, 10 log10(4)
        half = torch.full_like(image, 0.5)
        self.assert_values(psnr(half, image + 1), 6.0205999)

    def test_convention_region_of_a_centre_is_the_floor(self) -> None:
        labels = torch.tensor([[3, 5], [7, 9]], device=self.device)
        points = [[0.99, 0.5], [1.0, 0.5], [0.5, 1.0], [-4.0, 9.0], [9.0, -4.0]]
        ids = lookup_regions(torch.tensor(points, device=self.device), labels)
        assert ids.tolist() == [3, 5, 7, 7, 5]  # beyond the border that of the nearest pixel

    def test_convention_a_hard_contour_keeps_the_pixels_of_a_label(self) -> None:
        tensors = (torch.tensor([row], device=self.device, dtype=self.dtype) for row in ([2.5, 0.5], [1, 0, 1], [1]))
        labels = torch.tensor([[4, 4, 4, 6, 6]], device=self.device)
        ids = torch.tensor([4], device=self.device)
        image = region_splat(*tensors, ids, labels, backend=self.backend)
        self.assert_values(image[0], [[TWO, ONE, 1, 0, 0]])

    def test_convention_other_sizes_scale_pixel_corners(self) -> None:
        """A centre at (0.5, 0.5) of 1 x 2 pixels is at (1, 1) of 2 x 4: exp(-(1 / 16 + 1 / 16) / 2) at the first."""
        field = GaussianField(torch.tensor([[0.5, 0.5]]), torch.tensor([[1.0, 0, 1]]), torch.ones(1, 1), size=(1, 2))
        self.assert_values(Scene(field)(size=(2, 4))[0, :, :2], [[0.9394131, 0.9394131], [0.9394131, 0.9394131]])
