"""export/golden: torch, a decoder made from its README and the stored decoders render what the cases expect."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

import kcgs
from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from tests.maps.test_regions import stated_weights

ROOT = Path(kcgs.__file__).resolve().parent.parent
FOLDER = ROOT / "export" / "golden"
if not FOLDER.is_dir():
    pytest.skip("not a source checkout: there is no export/golden", allow_module_level=True)

NAMES = ("plain", "hard", "soft", "pairs", "needle")
MOST = 1e-3
Arrays = dict[str, np.ndarray]


def load_maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("kcgs_export_golden", FOLDER / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read(path: Path) -> Arrays:
    with np.load(path) as file:
        return dict(file)


def size_of(case: Arrays) -> tuple[int, int]:
    return int(case["height"]), int(case["width"])


def scene_of(case: Arrays) -> tuple[GaussianField, RegionMap | None]:
    """Build the scene from the arrays alone."""
    numbers = [torch.from_numpy(case[name]) for name in ("means", "cholesky", "colors")]
    opacities = torch.from_numpy(case["opacities"]) if "opacities" in case else None
    if "labels" not in case:
        return GaussianField(*numbers, opacities=opacities, size=size_of(case)), None
    labels, ids = (torch.from_numpy(case[name].astype(np.int64)) for name in ("labels", "region_ids"))
    pairs: Any = case["softness"]
    softness = {(int(a), int(b)): float(w) for a, b, w in pairs} if pairs.ndim else float(pairs)
    regions = RegionMap(labels, softness)
    return GaussianField(*numbers, ids, opacities, size=size_of(case)), regions


def wholes(case: Arrays) -> dict[tuple[int, int], np.ndarray]:
    names = [name for name in case if name.startswith("image_") and name[6].isdigit()]
    return {tuple(map(int, name[6:].split("x"))): case[name] for name in names}


def assert_same(image: Any, expected: np.ndarray) -> None:
    image = np.asarray(image)
    assert image.shape == expected.shape
    assert np.abs(image - expected).max() < MOST


def assert_renders(image: Callable[..., Any], case: Arrays) -> None:
    """Compare every image of a case with image(size, view=..., factors=...)."""
    for size, expected in wholes(case).items():
        assert_same(image(size), expected)
    assert_same(image(case["image_view"].shape[1:], view=case["view"]), case["image_view"])
    if "visible" in case:
        assert_same(image(size_of(case), factors=case["visible"]), case["image_visible"])


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def case(name: str) -> Arrays:
    return read(FOLDER / f"{name}.npz")


def test_made_again_they_are_the_same(tmp_path: Path) -> None:
    load_maker().make(tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == set(NAMES)
    for name in NAMES:
        stored, fresh = read(FOLDER / f"{name}.npz"), read(tmp_path / f"{name}.npz")
        assert list(fresh) == list(stored)
        for key, array in fresh.items():
            assert array.dtype == stored[key].dtype
            # another processor may add up float64 in another order
            error = 1e-6 if key.startswith("image_") else 0
            np.testing.assert_allclose(array, stored[key], rtol=0, atol=error)


def test_torch_renders_them(case: Arrays) -> None:
    field, regions = scene_of(case)
    render = RegionSplatRenderer(cutoff=float(case["cutoff"]))
    with torch.no_grad():
        for size, expected in wholes(case).items():
            assert_same(render(field, regions, size), expected)
        if regions is not None:
            visible = torch.from_numpy(case["visible"])[regions.index_of(field.region_ids)] > 0
            assert_same(render(field.subset(visible), regions), case["image_visible"])


class Described:
    """A decoder written from README.md alone, in numpy."""

    def __init__(self, case: Arrays) -> None:
        self.case, self.size = case, size_of(case)
        self.colors = case["colors"] * case.get("opacities", np.ones(len(case["means"])))[:, None].astype(float)
        self.ids = np.unique(case["labels"]) if "labels" in case else np.zeros(1)
        self.of = np.searchsorted(self.ids, case["region_ids"]) if "labels" in case else np.zeros(len(self.colors), int)

    def image(self, size: tuple[int, ...], view: Any = None, factors: Any = None) -> np.ndarray:
        left, top, right, bottom = (0, 0, self.size[1], self.size[0]) if view is None else view.tolist()
        needed = (
            min(math.ceil(e - 1 / 256), 2 * n) for e, n in zip((bottom - top, right - left), self.size, strict=True)
        )
        finer = tuple(max(*pair) for pair in zip(size, needed, strict=True))
        if finer != tuple(size):
            # every pixel in as many parts as the smaller image has, which then go into whole means
            image = self.image(finer, np.array([left, top, right, bottom]), factors)
            for axis, side in ((1, size[0]), (2, size[1])):
                shape = (*image.shape[:axis], side, image.shape[axis], *image.shape[axis + 1 :])
                image = image.repeat(side, axis).reshape(shape).mean(axis + 1)
            return image
        across, down = (right - left) / size[1], (bottom - top) / size[0]
        x, y = left + (np.arange(size[1]) + 0.5) * across, top + (np.arange(size[0]) + 0.5) * down
        l11, l21, l22 = self.case["cholesky"].astype(float).T[:, :, None, None]
        mx, my = self.case["means"].astype(float).T[:, :, None, None]
        z1 = (x - mx) / l11
        z2 = (y[:, None] - my - l21 * z1) / l22
        weight = np.exp(-(z1**2 + z2**2) / 2)
        weight[weight < self.case["cutoff"]] = 0
        if "labels" in self.case:
            weight *= self.memberships(x, y, 1 / (across * down))[self.of]
        colors = self.colors if factors is None else self.colors * factors[self.of][:, None]
        return np.einsum("nhw,nc->chw", weight, colors)

    def memberships(self, x: np.ndarray, y: np.ndarray, ratio: float) -> np.ndarray:
        labels, widths = self.case["labels"], self.case.get("contour_width")
        widths = np.full(self.size, self.case["softness"]) if widths is None else widths
        own = labels == self.ids[:, None, None]
        is_native = all(np.all(np.mod(at, 1) == 0.5) for at in (x, y))
        if is_native:
            inside, blurs = own.astype(float), widths
        else:
            tensors = torch.from_numpy(labels.astype(np.int64)), torch.from_numpy(widths.astype(float))
            inside, blurs = stated_weights(*tensors).numpy(), np.maximum(widths, 0.7)
        shares = np.empty_like(inside)
        for i, j in np.ndindex(*self.size):
            width = float(blurs[i, j])
            dy, dx = np.arange(self.size[0])[:, None] - i, np.arange(self.size[1]) - j
            near = (np.maximum(np.abs(dy), np.abs(dx)) <= np.ceil(np.round(4 * width, 4))).astype(float)
            near *= np.exp(-(dy**2 + dx**2) / (2 * width**2)) if width else 1.0
            shares[:, i, j] = (inside * near).sum((1, 2)) / near.sum()
        shares = np.concatenate([shares, widths.astype(float)[None] ** 2])
        for axis, at in ((1, y), (2, x)):
            low = np.floor(at - 0.5).astype(int)
            last = shares.shape[axis] - 1
            offset = (at - 0.5 - low)[:, None] if axis == 1 else at - 0.5 - low
            before, after = (shares.take((low + i).clip(0, last), axis) for i in (0, 1))
            shares = before * (1 - offset) + after * offset
        shares, variance = shares[:-1], shares[-1]
        square = (np.maximum(variance, 0.49) + 0.25) * ratio / (np.maximum(variance - 0.25, 0) * ratio + 0.25)
        powers = shares ** (1.0 if is_native else np.sqrt(square))
        return powers / powers.sum(0)


def test_description_is_enough_to_render_them(case: Arrays) -> None:
    assert_renders(Described(case).image, case)


def test_stored_decoder(name: str, case: Arrays) -> None:
    path = FOLDER / f"{name}.onnx"
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    notes = {entry.key: entry.value for entry in model.metadata_props}
    assert (int(notes["height"]), int(notes["width"])) == size_of(case)
    assert json.loads(notes["region_ids"]) == (np.unique(case["labels"]).tolist() if "labels" in case else [0])
    session, whole = onnxruntime.InferenceSession(path), np.array([0, 0, *size_of(case)[::-1]], np.float32)
    every = np.ones_like(case["visible"]) if "visible" in case else np.ones(1, np.float32)

    def decode(size: tuple[int, ...], view: np.ndarray = whole, factors: np.ndarray = every) -> np.ndarray:
        return session.run(["image"], {"size": np.array(size), "view": view, "visible": factors})[0][0]

    assert_renders(decode, case)
