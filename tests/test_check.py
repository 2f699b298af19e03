"""Checks of arguments, and the errors that they raise."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

from kcgs import InvalidArgument, InvalidArgumentType, RegionMap, evaluate, fit
from kcgs._check import check_count, check_number, check_numbers, check_size
from kcgs._image import as_image
from kcgs._labels import check_labels
from kcgs.data import load_image, load_labels, save_image, save_labels
from kcgs.functional import edge_band
from kcgs.segment import segment

LABELS = torch.tensor([[0, 1, 1], [0, 0, 1]])
LEVELS = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
GREY = np.arange(35, dtype=np.uint8).reshape(5, 7)
IMAGE = torch.from_numpy(LEVELS).permute(2, 0, 1).float() / 255


@pytest.mark.parametrize("kind", [InvalidArgument, InvalidArgumentType])
def test_errors_survive_pickling_and_copies(kind: type[InvalidArgument] | type[InvalidArgumentType]) -> None:
    error = kind("means", "shape (..., 2)", (2, 3), verb="have")
    for twin in (error, pickle.loads(pickle.dumps(error)), copy.copy(error), copy.deepcopy(error)):
        assert type(twin) is kind and str(twin) == "means must have shape (..., 2); got (2, 3)"
        assert (twin.name, twin.expected, twin.received) == ("means", "shape (..., 2)", (2, 3))


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: check_number("s", True, unit="pixels"), "s must be a number of pixels; got True"),
        *((lambda v=v: check_size("s", v), "s must be a pair") for v in ("ab", (1, 2, 3))),
        (lambda: check_size("s", (True, 3)), "s must hold two integers"),
        (lambda: as_image("i", torch.tensor([[[0.0, 2.0]]])), r"i must be in \[0, 1\]; got \[0, 2\]"),
        (lambda: as_image("i", np.zeros((3, 4, 3), np.int64)), "uint8, uint16, float32 or float64; got int64"),
        (lambda: as_image("i", np.zeros((3, 4, 5), np.float32)), "1 to 4 channels"),
        (lambda: as_image("i", torch.zeros(2, 3, 4, 4)), "must be one image"),
        (lambda: as_image("i", np.array([[0.5, 4.0]])), r"got \[0.5, 4\]: divide it by 4, or clip it"),
        (lambda: as_image("i", np.array([[7.0, 4.0]])), r"got \[4, 7\]: divide it by 255"),
        (lambda: as_image("i", np.full((2, 2, 4), 255.0)), r"i must be in \[0, 1\]; got \[255, 255\]"),
        *(
            (lambda s=s: as_image("i", torch.zeros(s)), r"looks like \(H, W, C\): pass i.permute\(2, 0, 1\)")
            for s in ((80, 120, 3), (1, 80, 120, 3))
        ),
    ],
)  # fmt: skip
def test_bad_arguments(check: Callable[[], object], message: str) -> None:
    with pytest.raises((InvalidArgument, InvalidArgumentType), match=message):
        check()


def test_numbers_of_numpy() -> None:
    assert check_count("n", np.int64(3)) == 3 and check_number("s", np.float32(0.5), 0, 8) == 0.5
    assert check_numbers("s", (0, 0.5, 1), 3, 0, 1) == (0.0, 0.5, 1.0) and check_size("s", [np.int64(2), 3]) == (2, 3)


@pytest.mark.parametrize("dtype", ["bool", "uint16", ">i2"])
def test_masks_and_arrays_are_labels(dtype: str) -> None:
    array = np.ascontiguousarray(LABELS.numpy()[:, ::-1])[:, ::-1].astype(dtype, order="K")  # of negative strides
    for value in (array, torch.from_numpy(array.astype(bool))):
        labels = check_labels("labels", value)
        assert torch.equal(labels, LABELS) and labels.dtype == torch.int64


def with_alpha(alpha: int) -> np.ndarray:
    return np.concatenate([LEVELS, np.full((5, 7, 1), alpha, np.uint8)], -1)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        *((image, IMAGE) for image in (IMAGE, IMAGE[None], LEVELS, LEVELS.astype(np.float32) / 255)),
        (Image.fromarray(LEVELS), IMAGE),
        *((image, torch.from_numpy(GREY)[None] / 255) for image in (GREY, GREY[..., None], Image.fromarray(GREY))),
        (Image.fromarray(GREY).convert("P"), (torch.from_numpy(GREY) / 255).expand(3, -1, -1)),
        (np.full((5, 7), 65535, np.uint16), torch.ones(1, 5, 7)),
        (with_alpha(255), IMAGE),
        (Image.fromarray(with_alpha(255)), IMAGE),
        (torch.zeros(4, 5, 7), torch.zeros(4, 5, 7)),
        # thin images, and many channels
        *((torch.zeros(shape), torch.zeros(shape)) for shape in ((3, 120, 3), (80, 3, 3), (80, 120, 2))),
    ],
)
def test_images(image: object, expected: torch.Tensor) -> None:
    assert torch.equal(as_image("image", image), expected)


def test_transparent_pixels_are_white_by_every_way_in(tmp_path: Path) -> None:
    image = Image.fromarray(with_alpha(0))
    image.save(tmp_path / "a.png")
    for value in (with_alpha(0), image, tmp_path / "a.png", str(tmp_path / "a.png")):
        with pytest.warns(UserWarning, match="composed on white") as caught:
            assert torch.equal(as_image("image", value), torch.ones(3, 5, 7))
        assert [warning.filename for warning in caught] == [__file__]
    save_image(tmp_path / "b.png", with_alpha(0))
    assert load_image(tmp_path / "b.png", channels="RGBA")[3].max() == 0


@pytest.mark.parametrize("mode", ["1", "P", "I;16", "RGB"])
def test_maps_mean_the_same_by_every_way_in(mode: str, tmp_path: Path) -> None:
    values = np.kron(np.array([[0, 1], [1, 0]]), np.ones((8, 8), int))
    image = Image.fromarray((values * 255).astype(np.uint16 if mode == "I;16" else np.uint8))
    image = image if mode == "I;16" else image.convert(mode)
    image.save(tmp_path / "map.png")
    expected = load_labels(tmp_path / "map.png")
    assert torch.equal(expected > 0, torch.from_numpy(values > 0))
    for value in (image, tmp_path / "map.png", str(tmp_path / "map.png")):
        assert torch.equal(RegionMap(value).labels, expected)
        assert torch.equal(edge_band(value), edge_band(expected))


@pytest.mark.filterwarnings("ignore:ms_ssim is NaN:RuntimeWarning")
def test_paths_are_arguments_of_fit_and_evaluate(tmp_path: Path) -> None:
    image, labels = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)), torch.eye(16).long()
    photo, mask = str(tmp_path / "photo.png"), tmp_path / "mask.png"
    save_image(photo, image)
    save_labels(mask, labels)
    scene = fit(photo, Image.open(mask), 20, iterations=2).scene
    assert scene.regions is not None and scene.regions.num_regions == 2
    assert evaluate(scene, photo, mask)["ef_psnr"] == evaluate(scene, load_image(photo), labels)["ef_psnr"]
    assert segment(photo).shape == (16, 16)


def soft_mask(blur: float, noise: int = 0) -> np.ndarray:
    """Return a disc with soft edges, or as the probabilities of a network, which are only near to dark and light."""
    y, x = np.mgrid[:96, :96] - 48
    mask = gaussian_filter(255.0 * (np.hypot(x, y) < 30), blur)
    mask = np.abs(mask - np.random.default_rng(0).uniform(0, noise, mask.shape)).round().astype(np.uint8)
    mask[0, 0], mask[48, 48] = 0, 255
    return mask


@pytest.mark.parametrize(
    ("blur", "noise", "convert"),
    [
        (1, 0, lambda m: Image.fromarray(m)),
        (1, 3, np.asarray),
        (5, 0, lambda m: Image.fromarray(m).convert("RGB")),
    ],
)
def test_masks_with_soft_edges_are_refused(blur: float, noise: int, convert: Callable[..., object]) -> None:
    assert RegionMap(convert(soft_mask(0))).num_regions == 2
    with pytest.raises(InvalidArgument, match=r"soft edges has: pass np\.asarray\(labels.*\) > 127"):
        RegionMap(convert(soft_mask(blur, noise)))


@pytest.mark.parametrize("mode", ["L", "LA", "RGB"])
def test_a_threshold_makes_two_regions_of_soft_edges(mode: str, tmp_path: Path) -> None:
    Image.fromarray(soft_mask(1)).convert(mode).save(tmp_path / "soft{}.png")
    np.save(tmp_path / "soft{}.npy", soft_mask(1))
    for path in (tmp_path / "soft{}.png", tmp_path / "soft{}.npy"):
        with pytest.raises(InvalidArgument, match=r"soft\{\}\.\w+', threshold=127\), or --threshold 127"):
            load_labels(path)
        assert torch.equal(load_labels(path, threshold=127), torch.from_numpy(soft_mask(1) > 127).long())


def test_many_ids_are_no_soft_edges() -> None:
    cells = np.kron(np.arange(144).reshape(12, 12), np.ones((4, 4))).astype(np.uint8)
    big = np.zeros((96, 96), np.uint8)
    big[:, 48:], big[:48, :48] = 255, cells
    for labels in (cells, big, np.asarray(Image.fromarray(cells).resize((20, 20), Image.Resampling.NEAREST))):
        assert RegionMap(labels).num_regions == len(np.unique(labels))


def test_images_may_pass_their_range_by_a_tolerance() -> None:
    image = torch.tensor([[[0.0, 1.0005]]])
    assert torch.equal(as_image("image", image, tolerance=1e-3), image)
