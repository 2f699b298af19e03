"""The objective of MS-SSIM, against autograd of its formula in float64."""

from __future__ import annotations

import pytest
import torch
from skimage import data
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from kcgs import fit
from kcgs.optim.gaussians import Gaussians
from kcgs.optim.ms_ssim import MsSsim


def photo(height: int, width: int, seed: int = 0) -> Tensor:
    """Return a smooth image with a rough half."""
    generator = torch.Generator().manual_seed(seed)
    ramp = torch.linspace(0.2, 0.8, width).expand(3, height, width).clone()
    ramp[:, :, width // 2 :] += 0.2 * (torch.rand(3, height, width - width // 2, generator=generator) - 0.5)
    return ramp.clamp(0, 1).double()


def lacking(image: Tensor, residual: Tensor) -> Tensor:
    """What MS-SSIM lacks without its finest scale, as a logarithm, channels averaged."""
    line = torch.exp(-0.5 * (torch.arange(-5.0, 6.0, dtype=torch.float64) / 1.5) ** 2)
    window = (line[:, None] * line / line.sum() ** 2)[None, None]
    x, y, total = image[:, None], (image + residual)[:, None], torch.zeros((), dtype=torch.float64)
    for scale, weight in enumerate((0.2856, 0.3001, 0.2363, 0.1333), 1):
        x, y = avg_pool2d(x, 2), avg_pool2d(y, 2)
        inside = conv2d(torch.ones_like(x), window, stride=2, padding=5)  # of windows that the border cuts
        mean_x, mean_y, xx, yy, xy = (
            conv2d(t, window, stride=2, padding=5) / inside for t in (x, y, x * x, y * y, x * y)
        )
        score = (2 * (xy - mean_x * mean_y) + 0.03**2) / (xx - mean_x**2 + yy - mean_y**2 + 0.03**2)
        if scale == 4:
            score = score * (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
        total = total - weight * score.mean((1, 2, 3)).log().mean()
    return total


class TestMsSsim:
    def test_is_the_gradient_of_its_formula(self) -> None:
        image, residual = photo(192, 208), 0.1 * photo(192, 208, seed=1)
        leaf = residual.clone().requires_grad_()
        objective = MsSsim(image)
        squared = 0.003 * leaf.square().sum()
        expected = lacking(image, leaf) / (objective.value(image + residual) - squared.detach() / leaf.numel())
        scale = float(expected.detach())  # the constant Z and the mean over pixels
        (slope,) = torch.autograd.grad(lacking(image, leaf) * leaf.numel() / scale + squared, leaf)
        torch.testing.assert_close(2 * objective.slope(image + residual), slope, rtol=1e-6, atol=1e-9)

    def test_is_symmetric_and_quadratic_near_the_image(self) -> None:
        image = photo(192, 208)
        objective, (a, b) = MsSsim(image), (1e-4 * (photo(192, 208, seed=s) - 0.5) for s in (1, 2))
        first, second = (float((a * objective.slope(image + b)).sum()) for a, b in ((a, b), (b, a)))
        assert first == pytest.approx(second, rel=1e-3)
        assert float(objective.value(image + 2 * a)) == pytest.approx(4 * float(objective.value(image + a)), rel=1e-2)
        # weights are those of the quadratic form
        means = torch.tensor([[60.5, 90.5]] * 3, dtype=torch.float64)
        sigmas = torch.tensor([2.0, 6.0, 20.0], dtype=torch.float64)
        cholesky = torch.stack([sigmas, 0 * sigmas, sigmas], -1)
        y, x = torch.meshgrid(torch.arange(192.0) + 0.5, torch.arange(208.0) + 0.5, indexing="ij")
        for weight, sigma in zip(objective.weigh(Gaussians(means, cholesky, means)), sigmas, strict=True):
            g = 1e-4 * torch.exp(-0.5 * ((x - 60.5) ** 2 + (y - 90.5) ** 2) / sigma**2).expand(3, -1, -1).double()
            assert float(weight) == pytest.approx(float(objective.value(image + g) / g.square().mean()), rel=0.35)

    @pytest.mark.parametrize(
        ("size", "dtype"), [((1, 1), torch.float32), ((70, 90), torch.float32), ((21, 30), torch.float64)]
    )
    def test_a_batch_is_as_each_image_alone(self, size: tuple[int, int], dtype: torch.dtype) -> None:
        """In float32, on a CPU, bit for bit: Z is that of each image."""
        images, residuals = (torch.stack([photo(*size, seed=s + k) for k in range(3)]).to(dtype) for s in (0, 5))
        images[1] = 0.5
        renders, tolerance = images + 0.1 * residuals, 0.0 if dtype == torch.float32 else 1e-12
        batch, alone = MsSsim(images), [MsSsim(image) for image in images]
        gaussians = Gaussians(
            torch.rand(3, 7, 2) * 20, torch.tensor([3.0, 0.0, 3.0]).expand(3, 7, 3), torch.ones(3, 7, 3)
        )
        for k, one in enumerate(alone):
            own = Gaussians(*(table[k] for table in gaussians[:3]))
            for actual, expected in (
                (batch.value(renders)[k], one.value(renders[k])),
                (batch.slope(renders.clone())[k], one.slope(renders[k].clone())),
                (batch.residual(renders).error[k], one.residual(renders[k]).error),
                (batch.weigh(gaussians)[k], one.weigh(own)),
            ):
                torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)

    @pytest.mark.parametrize("size", [(1, 9), (22, 30), (283, 39)])
    def test_compiled(self, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
        """Float32 is compiled: it agrees with float64, at all sizes and on any number of threads."""
        image, residual = photo(*size), 0.1 * photo(*size, seed=1)
        objective, expected = MsSsim(image.float()), MsSsim(image)
        render = image + residual
        slope = expected.slope(render.clone())
        slopes = []
        for threads in (1, 2):
            monkeypatch.setattr("kcgs.compiled.tasks.num_threads", lambda count=threads: count)
            slopes.append(objective.slope(render.float()))
        torch.testing.assert_close(slopes[0].double(), slope, rtol=0, atol=1e-3 * float(slope.abs().max()))
        assert torch.equal(*slopes)
        assert float(objective.value(render.float())) == pytest.approx(float(expected.value(render)), rel=1e-4)
        assert (
            objective.weigh(Gaussians(torch.ones(1, 2), torch.tensor([[3.0, 0.0, 3.0]]), torch.ones(1, 3)))
            .isfinite()
            .all()
        )


class TestFit:
    def test_lowers_its_own_error_more(self) -> None:
        image = torch.from_numpy(data.astronaut()[:64, 176:272] / 255).permute(2, 0, 1).float()
        objective = MsSsim(image)
        value: dict[str, float] = {}
        for name in ("l2", "ms-ssim"):
            render = fit(image, None, 40, iterations=60, objective=name).scene.render().clamp(0, 1)
            value[name] = float(objective.value(render))
        assert value["ms-ssim"] < value["l2"]
