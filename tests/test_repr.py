"""Public objects at a prompt, a line or two, and in a notebook, an image."""

from __future__ import annotations

import importlib
import inspect
import io
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import kcgs
from kcgs import FitConfig, GaussianField, RegionMap, RegionSplatRenderer, Scene, codec, fit, prune
from kcgs.data import ChartSample, Davis, DavisFrame, SceneDataset, save_image, save_labels, save_shard
from kcgs.fitting import FitResult, available_recipes
from kcgs.fitting.events import Densify
from kcgs.fitting.gaussian_image import GaussianImageAdan
from kcgs.fitting.problem import make_problem
from kcgs.fitting.start import start
from kcgs.functional import PairSoftness
from kcgs.rate import Compressed, FitBytesResult
from kcgs.segment import Cleanup, Prediction, Segmentation
from kcgs.video import read_video
from kcgs.zoo import entries

SIZE = (64, 96)
PRIVATE = {"kcgs.cli", "kcgs.compiled", "kcgs.kernels", "kcgs.maps"}
LABELS = torch.arange(64 * 96).reshape(SIZE) // 300
WIDTHS = {(region, region + 1): 0.3 + 0.1 * region for region in range(20)}


@pytest.fixture(scope="module")
def result() -> FitResult:
    image = torch.linspace(0.0, 1.0, 96).expand(3, *SIZE)
    labels = (image[0] > 0.5).long()
    return fit(image, labels, 40, iterations=110, merge_regions=False)


def objects(result: FitResult, folder: Path) -> Iterator[Any]:
    """Yield an object of every public class, as large as those of users."""
    field = GaussianField.random(4000, SIZE, regions=LABELS, seed=0)
    regions = RegionMap(LABELS, WIDTHS)
    scene = Scene(field, regions, {"title": "a long note " * 40})
    image, data = torch.rand(3, *SIZE), codec.encode(result.scene)
    yield from (result, result.history[0], result.regions, field, regions, regions.resize((128, 192)), scene)
    yield from (PairSoftness(WIDTHS), RegionSplatRenderer())
    yield from (start(make_problem(image, LABELS, 400, FitConfig(), 0)), Densify())
    yield GaussianImageAdan(GaussianField.random(3, SIZE, seed=0), 2.0, 100, 1.0)
    yield from (FitConfig.from_recipe(recipe) for recipe in available_recipes())
    yield from (codec.decode(data), Compressed(data, scene), FitBytesResult(data, scene, result), prune(result.scene))
    yield from (Segmentation(LABELS, torch.rand(21), {i: f"name {i}" for i in range(21)}), Cleanup())
    yield from (Prediction(LABELS.numpy(), torch.rand(SIZE), [f"name {i}" for i in range(21)]), *entries())
    folder.mkdir(exist_ok=True)
    batch = Scene(GaussianField.stack([field] * 3), LABELS.expand(3, -1, -1))
    save_shard(folder / "00000.safetensors", batch, ["a long name " * 9] * 3, [30.0] * 3)
    dataset = SceneDataset(folder)
    yield from (dataset, dataset.batch([0, 2]))
    yield from (ChartSample(image, LABELS), DavisFrame("bear", image, LABELS))
    for kind in ("JPEGImages", "Annotations"):
        (folder / kind / "480p" / "bear").mkdir(parents=True)
    save_image(folder / "JPEGImages/480p/bear/00000.jpg", image)
    save_labels(folder / "Annotations/480p/bear/00000.png", LABELS)
    yield Davis(folder)
    yield read_video(folder / "JPEGImages/480p/bear")


def public_classes() -> set[type]:
    names = [f"kcgs.{module.name}" for module in pkgutil.iter_modules(kcgs.__path__) if module.name[0] != "_"]
    modules = [kcgs, *(importlib.import_module(name) for name in names if name not in PRIVATE)]
    public = {getattr(module, name) for module in modules for name in getattr(module, "__all__", ())}
    foreign = (Exception, torch.optim.Optimizer)  # with a repr of Python's or torch's
    classes = {kind for kind in public if inspect.isclass(kind) and not getattr(kind, "_is_protocol", False)}
    return {kind for kind in classes if not issubclass(kind, foreign)}


def test_every_public_class(result: FitResult, tmp_path: Path) -> None:
    examples = list(objects(result, tmp_path))
    for example in examples:
        lines = repr(example).split("\n")
        assert len(lines) <= 2 and max(map(len, lines)) <= 200, lines
    assert not {kind for kind in public_classes() if not any(isinstance(example, kind) for example in examples)}


def test_values_in_a_repr(result: FitResult) -> None:
    count = result.scene.num_gaussians
    assert repr(result.scene) == f"Scene({count} Gaussians, 3 channels, size=(64, 96), confined, 2 regions)"
    start = f"FitResult({result.psnr:.2f} dB, stopped by iterations, "
    assert repr(result).startswith(start) and repr(result).endswith(f" s, {result.scene!r})")
    assert repr(result.scene.regions).startswith("RegionMap(2 regions, size=(64, 96), softness=")
    assert repr(Segmentation(LABELS)) == "Segmentation(labels=int64 (64, 96), scores=None, names=None)"
    assert repr(FitConfig(iterations=9)) == "FitConfig(iterations=9)"


def test_images_in_a_notebook(result: FitResult) -> None:
    pixels = np.asarray(Image.open(io.BytesIO(result._repr_png_())))
    expected = (result.scene.render().permute(1, 2, 0) * 255).round().numpy()
    assert np.array_equal(pixels, expected) and result.scene._repr_png_() == result._repr_png_()
    for channels, mode in ((1, "L"), (4, "RGBA")):
        scene = Scene(GaussianField.random(5, (20, 3000), channels=channels, seed=0))
        with Image.open(io.BytesIO(scene._repr_png_())) as image:
            assert (image.mode, image.size) == (mode, (1024, 7))
    assert Scene(GaussianField.random(5, SIZE, channels=7, seed=0))._repr_png_() is None
    assert Scene(GaussianField.stack([result.scene.field] * 2))._repr_png_() is None


def test_plot(result: FitResult, tmp_path: Path) -> None:
    figure = result.plot()
    figure.savefig(tmp_path / "plot.png")
    assert figure._repr_png_()[:4] == b"\x89PNG"
    lines = figure.axes[0].get_lines()
    assert list(lines[0].get_xdata()) == [entry.seconds for entry in result.history]
    assert figure.axes[0].get_title() == "error against run time" and len(lines) == 2
