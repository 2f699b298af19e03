"""Image metrics against float64 transcriptions of their papers, pytorch-msssim, and at their limits."""

import itertools
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import pytorch_msssim
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import correlate1d, distance_transform_edt
from skimage import data
from torch import Tensor

from kcgs.data import load_image, save_image
from kcgs.functional import METRICS, ef_psnr, ef_ssim, ms_ssim, psnr, ssim, ssimulacra2
from kcgs.functional.similarity import mean_ssim
from tests.tester import BaseTester

Array = NDArray[np.float64]
Metric = Callable[..., Tensor]
PHOTOS = ("astronaut", "coffee")
# metrics in torch, of the whole image and along contours
PLAIN = [metric.function for metric in METRICS.values() if not metric.takes_labels and not metric.is_optional]
EDGE_FOCUSED = [metric.function for metric in METRICS.values() if metric.takes_labels]


def photo_pair(name: str, rows: int = 176, columns: int = 192) -> tuple[Tensor, Tensor]:
    """Return a photo and a blurred, noisy copy that leaves [0, 1], (3, rows, columns) float64."""
    photo = torch.from_numpy(getattr(data, name)()[100 : 100 + rows, 150 : 150 + columns]).double().permute(2, 0, 1)
    photo = photo / 255.0
    noise = torch.randn(photo.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    blurred = 0.5 * photo + 0.25 * (photo.roll(2, -1) + photo.roll(2, -2))
    return (1.2 * (blurred - 0.5) + 0.5 + 0.05 * noise), photo


def similarity_maps(first: Array, second: Array) -> tuple[Array, Array]:
    """SSIM and its contrast-structure factor at every pixel of one channel, as in Wang et al. 2004."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(values: Array) -> Array:
        rows: Array = correlate1d(values, window, 0, mode="mirror")
        return np.asarray(correlate1d(rows, window, 1, mode="mirror"))

    mu1, mu2 = mean(first), mean(second)
    var1, var2 = mean(first**2) - mu1**2, mean(second**2) - mu2**2
    structure = (2 * (mean(first * second) - mu1 * mu2) + 0.03**2) / (var1 + var2 + 0.03**2)
    return structure * (2 * mu1 * mu2 + 0.01**2) / (mu1**2 + mu2**2 + 0.01**2), structure


def clipped(image: Tensor) -> Array:
    """Image as a float64 array in [0, 1]."""
    return np.asarray(image.double().clamp(0.0, 1.0).numpy())


def reference_ssim_map(image: Tensor, target: Tensor) -> Array:
    """SSIM at every pixel, (C, H, W)."""
    pairs = zip(clipped(image), clipped(target), strict=True)
    return np.stack([similarity_maps(first, second)[0] for first, second in pairs])


def reference_ssim(image: Tensor, target: Tensor) -> float:
    return float(reference_ssim_map(image, target)[:, 5:-5, 5:-5].mean())


def halved(values: Array) -> Array:
    """Average each pixel with its right and lower neighbours, mirrored at the end; keep every other one."""
    grown = np.pad(values, ((0, 1), (0, 1)), mode="symmetric")
    return (0.25 * (grown[:-1, :-1] + grown[1:, :-1] + grown[:-1, 1:] + grown[1:, 1:]))[::2, ::2]


def reference_ms_ssim(image: Tensor, target: Tensor) -> float:
    """Wang et al. 2003 for each channel, then averaged."""
    products = []
    for first, second in zip(clipped(image), clipped(target), strict=True):
        product = 1.0
        for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
            whole, structure = similarity_maps(first, second)
            term = (whole if scale == 4 else structure)[5:-5, 5:-5].mean()
            product *= max(term, 0.0) ** weight
            first, second = halved(first), halved(second)
        products.append(product)
    return float(np.mean(products))


def disc_labels(rows: int, columns: int) -> Tensor:
    """Three regions with ids that are not consecutive."""
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    disc = (y - rows // 2) ** 2 + (x - columns // 3) ** 2 < (rows // 4) ** 2
    return torch.where(disc, 7, torch.where(x > columns * 4 // 5, 300, 0))


def small_pair() -> tuple[Tensor, Tensor]:
    """Return two images inside [0, 1], which clipping leaves as they are."""
    image, target = 0.1 + 0.8 * torch.rand(2, 1, 11, 12, generator=torch.Generator().manual_seed(1))
    return image, target


def reference_band(labels: Tensor, width: float) -> NDArray[np.bool_]:
    """Pixels within `width` of a pixel of another label, by exact distance transforms."""
    values = labels.numpy()
    distance = np.zeros(values.shape)
    for label in np.unique(values):
        distance += distance_transform_edt(values == label)
    return np.asarray(distance <= width)


class TestPsnr:
    def test_pools_error_over_pixels_and_channels(self) -> None:
        image, target = photo_pair("coffee")
        expected = -10 * np.log10(np.mean((clipped(image) - clipped(target)) ** 2))
        assert abs(float(psnr(image, target)) - expected) < 1e-12
        assert abs(float(psnr(image.float(), target.float())) - expected) < 1e-4

    def test_identical_is_infinite_and_others_are_not(self) -> None:
        image = torch.rand(2, 1, 5, 5)
        other = image.clone()
        other[1, 0, 2, 2] += 0.5 - image[1, 0, 2, 2].round()
        assert torch.isinf(psnr(image, other)).tolist() == [True, False]


class TestSsim:
    def test_matches_paper(self) -> None:
        image, target = photo_pair("astronaut")
        expected = reference_ssim(image, target)
        assert 0.2 < expected < 0.95
        assert abs(float(ssim(image, target)) - expected) < 1e-12
        assert abs(float(ssim(image.float(), target.float())) - expected) < 2e-5

    def test_autocast_changes_nothing(self) -> None:
        image, target = (t.float() for t in photo_pair("coffee", 64, 64))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            inside = ssim(image, target)
        assert inside.dtype == torch.float32
        assert torch.equal(inside, ssim(image, target))


class TestMsSsim:
    def test_matches_paper(self) -> None:
        """Sides are odd at several scales."""
        image, target = photo_pair("coffee", 201, 187)
        expected = reference_ms_ssim(image, target)
        assert 0.5 < expected < 0.99
        assert abs(float(ms_ssim(image, target)) - expected) < 1e-12
        assert abs(float(ms_ssim(image.float(), target.float())) - expected) < 2e-5

    def test_negative_structure_of_one_scale_is_zero(self) -> None:
        coarse = torch.linspace(0.3, 0.7, 161).expand(1, 161, 161)
        fine = 0.2 * (-1.0) ** torch.arange(161)[:, None]  # gone at the next scale
        assert ms_ssim(coarse + fine, coarse - fine) == 0.0
        assert ms_ssim(coarse + fine, coarse + 0.8 * fine) > 0.9


def test_is_that_of_pytorch_msssim_where_sides_stay_even() -> None:
    """Its window is rounded to float32 whatever the images are."""
    image, target = (t.clamp(0, 1) for t in photo_pair("coffee"))
    for metric, other in ((ssim, pytorch_msssim.ssim), (ms_ssim, pytorch_msssim.ms_ssim)):
        expected = other(image[None], target[None], data_range=1.0)
        assert abs(float(metric(image, target) - expected)) < 2e-5


class TestEdgeFocused(BaseTester, without={"test_module": "metrics are functions"}):
    @pytest.mark.parametrize("metric", EDGE_FOCUSED)
    def test_smoke(self, metric: Metric, device: torch.device, dtype: torch.dtype) -> None:
        image, target = (t.to(device, dtype) for t in photo_pair("coffee", 20, 24))
        value = metric(image, target, disc_labels(20, 24).to(device))
        assert value.isfinite() and value.device.type == device.type
        assert value.dtype == torch.promote_types(dtype, torch.float32)

    @pytest.mark.parametrize("metric", EDGE_FOCUSED)
    @pytest.mark.parametrize(("lead", "channels"), [((), 1), ((2,), 4)])
    def test_cardinality(
        self, metric: Metric, device: torch.device, dtype: torch.dtype, lead: tuple[int, ...], channels: int
    ) -> None:
        image, target = (
            t.to(device, dtype)[torch.arange(channels) % 3].expand(*lead, channels, 20, 24)
            for t in photo_pair("coffee", 20, 24)
        )
        labels = disc_labels(20, 24).to(device)
        value = metric(image, target, labels)
        assert value.shape == lead
        self.assert_close(metric(image, target, labels.expand(*lead, 20, 24)), value)

    @pytest.mark.parametrize(
        ("labels", "width", "error", "words"),
        [
            (torch.full((16, 20), 0.5), 5, ValueError, "labels must hold whole numbers; got 0.5"),
            (disc_labels(20, 16), 5, ValueError, r"labels must have shape \(16, 20\) or \(2, 16, 20\)"),
            (disc_labels(16, 20), 0, ValueError, "width"),
        ],
    )
    def test_exception(self, labels: Tensor, width: float, error: type[Exception], words: str) -> None:
        image = torch.rand(2, 3, 16, 20)
        for metric in EDGE_FOCUSED:
            with pytest.raises(error, match=words):
                metric(image, image, labels, width)

    @pytest.mark.parametrize("metric", EDGE_FOCUSED)
    def test_gradcheck(self, metric: Metric) -> None:
        image, target = small_pair()
        self.gradcheck(metric, (image, target, disc_labels(11, 12), 2))

    @pytest.mark.parametrize("metric", EDGE_FOCUSED)
    def test_dynamo(self, metric: Metric, device: torch.device, dtype: torch.dtype) -> None:
        image, target = (t.to(device, dtype) for t in small_pair())
        image.requires_grad_()
        labels = disc_labels(11, 12).to(device)
        self.assert_compiles(lambda i, t: metric(i, t, labels, 1), image, target, leaves=[image])

    def test_feature(self) -> None:
        """PSNR and SSIM over the band, by its definition."""
        image, target = photo_pair("astronaut", 64, 80)
        labels = disc_labels(64, 80)
        for width in (1, 5):
            band = reference_band(labels, width)
            assert 0 < band.mean() < 0.5
            expected = -10 * np.log10(np.mean((clipped(image) - clipped(target))[:, band] ** 2))
            assert abs(float(ef_psnr(image, target, labels, width)) - expected) < 1e-12
            expected = reference_ssim_map(image, target)[:, band].mean()
            assert abs(float(ef_ssim(image, target, labels, width)) - expected) < 1e-12
        for metric in EDGE_FOCUSED:
            assert metric(image, target, labels) == metric(image, target, labels, 5)

    @pytest.mark.parametrize("metric", EDGE_FOCUSED)
    def test_one_map_for_all_or_one_each(self, metric: Metric) -> None:
        pairs = [photo_pair(name, 64, 80) for name in PHOTOS]
        images, targets = (torch.stack(part) for part in zip(*pairs, strict=True))
        maps = torch.stack([disc_labels(64, 80), disc_labels(64, 80).flip(1)])
        each = torch.stack([metric(i, t, m) for i, t, m in zip(images, targets, maps, strict=True)])
        shared = torch.stack([metric(i, t, maps[0]) for i, t in zip(images, targets, strict=True)])
        torch.testing.assert_close(metric(images, targets, maps), each, atol=1e-12, rtol=0)
        torch.testing.assert_close(metric(images, targets, maps[0]), shared, atol=1e-12, rtol=0)
        torch.testing.assert_close(metric(images, targets, maps[:1]), shared, atol=1e-12, rtol=0)
        assert (each - shared).abs().tolist()[1] > 1e-3

    @pytest.mark.parametrize("metric", EDGE_FOCUSED)
    def test_one_region_is_nan_and_says_so(self, metric: Metric) -> None:
        image, target = photo_pair("coffee", 20, 20)
        flat, split = torch.full((20, 20), 4), disc_labels(20, 20)
        with pytest.warns(RuntimeWarning, match="NaN: the label map has one region and so no edge band") as warnings:
            assert metric(image, target, flat).isnan()
        assert warnings[0].filename == __file__
        with pytest.warns(RuntimeWarning, match="1 of 2 label maps have one region"):
            values = metric(torch.stack([image] * 2), torch.stack([target] * 2), torch.stack([split, flat]))
        assert values.isnan().tolist() == [False, True]


class TestCardinality:
    @pytest.mark.parametrize("metric", PLAIN)
    def test_four_channels_batched_or_not(self, metric: Metric) -> None:
        image, target = (t[[0, 1, 2, 0]].float() for t in photo_pair("coffee", 161, 161))
        single, other = metric(image, target), metric(target.flip(-1), target)
        assert single.shape == ()
        batch = metric(torch.stack([image, target.flip(-1)]), torch.stack([target, target]))
        assert batch.shape == (2,)
        torch.testing.assert_close(batch, torch.stack([single, other]), atol=1e-5, rtol=0)
        assert abs(single - other) > 1e-2

    @pytest.mark.parametrize("metric", PLAIN)
    @pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
    def test_dtypes(self, metric: Metric, dtype: torch.dtype) -> None:
        """Half precision is computed in float32; two dtypes meet in the wider one."""
        image, target = (t.to(dtype) for t in photo_pair("coffee", 161, 161))
        wide = torch.promote_types(dtype, torch.float32)
        value = metric(image, target)
        assert value.dtype == wide and value == metric(image.to(wide), target.to(wide))
        assert metric(image, target.double()).dtype == torch.float64


class TestTooSmall:
    @pytest.mark.parametrize(
        ("metric", "size", "window"),
        [
            (ssim, (50, 10), 11),
            (ms_ssim, (160, 400), 161),
            (lambda image, target: ef_ssim(image, target, disc_labels(10, 30)), (10, 30), 11),
        ],
    )
    def test_is_nan_with_a_warning(self, metric: Metric, size: tuple[int, int], window: int) -> None:
        image = torch.rand(2, 3, *size)
        words = rf"ssim is NaN.* {size[0]} x {size[1]} .*{window} x {window}"
        with pytest.warns(RuntimeWarning, match=words) as warnings:
            values = metric(image, image)
        assert values.shape == (2,) and values.isnan().all() and warnings[0].filename == __file__


class TestSsimulacra2:
    def test_values(self, tmp_path: Path) -> None:
        package = pytest.importorskip("ssimulacra2", reason="SSIMULACRA2 needs the package ssimulacra2")
        photo = torch.from_numpy(data.astronaut()[:256, :240].copy()).permute(2, 0, 1).float() / 255
        assert ssimulacra2(photo, photo) == 100
        save_image(tmp_path / "photo.png", photo)
        scores = []
        for quality in (90, 10):
            Image.open(tmp_path / "photo.png").save(tmp_path / f"{quality}.jpg", quality=quality)
            scores.append(float(ssimulacra2(load_image(tmp_path / f"{quality}.jpg"), photo)))
            expected = package.compute_ssimulacra2(tmp_path / "photo.png", tmp_path / f"{quality}.jpg")
            assert scores[-1] == pytest.approx(expected, abs=1e-9)
        assert 100 > scores[0] > 70 > 40 > scores[1]
        batch = ssimulacra2(torch.stack([photo, 0.9 * photo]), torch.stack([photo, photo]))
        assert batch.tolist() == [100, float(ssimulacra2(0.9 * photo, photo))]
        grey, dark = photo[:1], photo[:1] * 0.9
        assert ssimulacra2(dark, grey) == ssimulacra2(dark.expand(3, -1, -1), grey.expand(3, -1, -1)) < 100

    def test_not_defined(self) -> None:
        assert all(ssimulacra2(t, t).isnan() for t in (torch.ones(3, 7, 60), torch.ones(4, 40, 60)))

    def test_without_its_package(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ssimulacra2", None)
        with pytest.raises(ImportError, match="pip install ssimulacra2"):
            ssimulacra2(torch.ones(3, 40, 60), torch.ones(3, 40, 60))


class TestGradient:
    @pytest.mark.parametrize("metric", [psnr, ssim])
    def test_gradcheck(self, metric: Metric) -> None:
        BaseTester.gradcheck(metric, small_pair())

    def test_second_derivatives_forward_mode_and_vmap(self) -> None:
        image, target = (t.double() for t in small_pair())
        along = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).reshape(image.shape)
        slope = torch.func.grad(ssim)(image, target)
        _, rise = torch.func.jvp(lambda i: ssim(i, target), (image,), (along,))
        self.assert_near(rise, (slope * along).sum())
        _, change = torch.func.jvp(lambda i: torch.func.grad(ssim)(i, target), (image,), (along,))
        ahead, behind = (torch.func.grad(ssim)(image + sign * 1e-5 * along, target) for sign in (1, -1))
        self.assert_near(change, (ahead - behind) / 2e-5)
        images = torch.stack([image, target, 0.5 * image])
        self.assert_near(torch.func.vmap(ssim, (0, None))(images, target), ssim(images, target.expand_as(images)))
        assert torch.autograd.gradgradcheck(lambda i: ssim(i, target), image.requires_grad_(), fast_mode=True)

    @staticmethod
    def assert_near(value: Tensor, expected: Tensor) -> None:
        torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-9)
        assert expected.any()

    def test_ascent_on_ms_ssim(self) -> None:
        image, target = (t.float() for t in photo_pair("coffee", 161, 161))
        image = image.clamp(0.01, 0.99).requires_grad_()
        before = ms_ssim(image, target)
        (gradient,) = torch.autograd.grad(before, image)
        assert ms_ssim(image.detach() + 0.01 * gradient / gradient.abs().max(), target) > before


class _MetaDevice(Tensor):
    """A finite tensor whose device is not the CPU, which every machine has: a subclass that says so."""

    @property
    def device(self) -> torch.device:
        return torch.device("meta")


IMAGE = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("image", "target", "error", "words"),
    [
        (IMAGE.numpy(), IMAGE, TypeError, "image must be a Tensor"),
        (IMAGE, (IMAGE * 255).byte(), TypeError, "target must have a real floating dtype"),
        (IMAGE, IMAGE[:1], ValueError, r"target must have the shape of image, \(3, 16, 16\)"),
        (IMAGE[0], IMAGE[0], ValueError, "image must have 3 or 4 dimensions"),
        (IMAGE[:0], IMAGE[:0], ValueError, "image must not be empty"),
        (IMAGE, IMAGE.index_fill(0, torch.tensor(1), torch.nan), ValueError, "target must be finite"),
        (IMAGE, IMAGE.as_subclass(_MetaDevice), ValueError, "target must be on cpu"),
    ],
)
def test_exception(image: Tensor, target: Tensor, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        psnr(image, target)


class TestLargeImages:
    """Blocks of rows give what the whole image gives, in less memory."""

    def test_blocks_agree_with_the_whole(self, monkeypatch: pytest.MonkeyPatch) -> None:
        labels = (torch.arange(192) > 90).long().expand(176, 192)
        metrics = [ssim, ms_ssim, lambda image, target: ef_ssim(image, target, labels)]
        image, target = photo_pair("coffee")
        images, targets = torch.stack([image, target.flip(-1)]).requires_grad_(), torch.stack([target, target])
        monkeypatch.setattr(f"{mean_ssim.__module__}._BLOCK", 1 << 30)
        whole = [metric(images, targets) for metric in metrics]
        slopes = [torch.autograd.grad(value.sum(), images)[0] for value in whole]
        monkeypatch.setattr(f"{mean_ssim.__module__}._BLOCK", 1)  # as few rows as may be
        for metric, value, slope in zip(metrics, whole, slopes, strict=True):
            blocks = metric(images, targets)
            assert torch.allclose(blocks, value, rtol=0, atol=1e-11)
            assert torch.allclose(torch.autograd.grad(blocks.sum(), images)[0], slope, rtol=1e-8, atol=1e-12)
            single = metric(images.float(), targets.float())
            assert torch.allclose(single, value.float(), rtol=0, atol=5e-6)  # what float32 has of variances

    def test_memory_of_a_large_image(self) -> None:
        """Two megapixels took 1.5 GB for SSIM, ten times the two images and their clipped copies."""
        images = torch.rand(2, 3, 1200, 1700)
        with torch.profiler.profile(profile_memory=True) as profile:
            ssim(*images)
        events = profile.profiler.kineto_results.events()
        peak = max(itertools.accumulate(event.nbytes() for event in events if event.name() == "[memory]"))
        assert 0 < peak < 4 * images.nbytes
