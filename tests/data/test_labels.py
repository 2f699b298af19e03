"""Label maps on disk: what each kind of file means, and round trips."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from kcgs.data import load_labels, save_labels

MAP = np.array([[0, 1, 1, 5], [0, 3, 5, 5]], np.uint8)
LARGE = np.kron(MAP, np.ones((4, 4), np.uint8))
COLORS = np.array([[[255, 0, 0], [0, 0, 255]], [[0, 255, 0], [0, 0, 255]]], np.uint8)
CLEAR_COLORS = np.array([[[9, 9, 9, 0], [5, 5, 5, 0], [5, 5, 5, 255], [5, 5, 5, 128]]], np.uint8)
INDEX = np.arange(4097)
MANY_COLORS = np.stack([INDEX >> 8, INDEX & 255, 0 * INDEX], axis=-1).astype(np.uint8)[None]


def write(path: Path, samples: np.ndarray, palette: list[int] | None = None, **options: Any) -> Path:
    if path.suffix == ".npy":
        np.save(path, samples, **options)
    elif path.suffix == ".tiff":
        tifffile.imwrite(path, samples, **options)
    else:
        image = Image.fromarray(samples)
        if palette is not None:
            image.putpalette(palette)
        image.save(path, **options)
    return path


PALETTE = [v for k in range(6) for v in (k * 40, 255 - k * 40, 7)]


class TestLoadLabels:
    @pytest.mark.parametrize(
        ("name", "samples", "options", "expected"),
        [
            # equal colours of different indices, as careless tools write them: the index counts
            ("a.png", MAP, {"palette": [9, 9, 9] * 6}, MAP),
            ("a.png", MAP, {"palette": list(range(18)), "bits": 4, "transparency": 0}, MAP),
            ("a.png", (MAP > 2).astype(np.uint8) * 255, {}, (MAP > 2) * 255),
            ("a.png", MAP.astype(np.uint16) * 9000, {}, MAP.astype(int) * 9000),
            ("a.tif", MAP.astype(np.uint16) * 9000, {}, MAP.astype(int) * 9000),
            ("a.tiff", MAP.astype(np.int32), {}, MAP),
            ("a.gif", LARGE, {"palette": PALETTE, "optimize": False}, LARGE),
            ("a.bmp", LARGE, {"palette": PALETTE}, LARGE),
            ("a.png", COLORS, {}, [[2, 0], [1, 0]]),
            ("a.png", CLEAR_COLORS, {}, [[0, 0, 2, 1]]),
            ("a.png", MANY_COLORS[:, :4096], {}, [range(4096)]),
            *(("a.npy", MAP.astype(dtype), {}, MAP) for dtype in (np.uint64, ">i4")),
            ("a.npy", MAP > 2, {}, MAP > 2),
        ],
    )
    def test_every_kind(
        self, tmp_path: Path, name: str, samples: np.ndarray, options: dict[str, Any], expected: Any
    ) -> None:
        labels = load_labels(write(tmp_path / name, samples, **options))
        assert labels.dtype == torch.int64
        np.testing.assert_array_equal(labels, expected)

    @pytest.mark.parametrize(
        ("name", "samples", "options", "message"),
        [
            ("a.png", MANY_COLORS, {}, r"at most 4096 distinct colours; got 4097 in .*a\.png"),
            ("a.png", COLORS, {"format": "JPEG"}, r"must be a label map in a lossless format .* got JPEG"),
            ("a.tif", COLORS, {"compression": "jpeg"}, r"must be a label map in a lossless format .* got"),
            ("a.tiff", MAP.astype(np.float32), {}, r"a\.tiff must have an integer dtype; got float32"),
            ("a.tiff", MAP.astype(np.int16) - 1, {}, r"a\.tiff must hold non-negative ids; got -1"),
            ("a.npy", np.full((2, 2), 2**63, np.uint64), {}, r"must hold ids below 2\*\*63"),
            ("a.npy", MAP[None], {}, r"must have 2 dimensions; got shape \(1, 2, 4\)"),
            ("a.npy", np.zeros((0, 3), int), {}, r"must have at least one pixel; got shape \(0, 3\)"),
            ("a.npy", np.array([[{}]], object), {"allow_pickle": True}, r"cannot read .*allow_pickle=False"),
        ],
    )
    def test_bad_maps(
        self, tmp_path: Path, name: str, samples: np.ndarray, options: dict[str, Any], message: str
    ) -> None:
        with pytest.raises((ValueError, TypeError), match=message):
            load_labels(write(tmp_path / name, samples, **options))

    @pytest.mark.parametrize(("name", "cut"), [("a.png", 30), ("a.npy", 3)])
    def test_bad_files(self, tmp_path: Path, name: str, cut: int) -> None:
        path = tmp_path / name
        with pytest.raises(FileNotFoundError, match=name):
            load_labels(path)
        for data in (b"text", write(path, MAP).read_bytes()[:-cut]):
            path.write_bytes(data)
            with pytest.raises(ValueError, match=rf"cannot read .*{name}"):
                load_labels(path)


class TestSaveLabels:
    @pytest.mark.parametrize(("suffix", "highest"), [(".png", 255), (".png", 65535), (".npy", 1 << 62)])
    def test_round_trip(self, tmp_path: Path, suffix: str, highest: int) -> None:
        labels = torch.tensor([[0, 3, highest], [3, 0, 9]])
        save_labels(tmp_path / f"a{suffix}", labels)
        assert torch.equal(load_labels(tmp_path / f"a{suffix}"), labels)

    def test_kinds_of_png(self, tmp_path: Path) -> None:
        save_labels(tmp_path / "a.png", torch.tensor([[0, 1, 255]]))
        with Image.open(tmp_path / "a.png") as image:
            assert image.mode == "P" and np.asarray(image).tolist() == [[0, 1, 255]]
            assert len(np.unique(np.asarray(image.convert("RGB"))[0], axis=0)) == 3
        save_labels(tmp_path / "a.png", torch.tensor([[0, 256, 65535]]))
        assert (tmp_path / "a.png").read_bytes()[24:26] == bytes([16, 0])  # grey of 16 bits

    @pytest.mark.parametrize(
        ("name", "labels", "error", "message"),
        [
            ("a.png", torch.tensor([[65536]]), ValueError, r"labels for a \.png must be at most 65535; got 65536"),
            ("a.tif", torch.from_numpy(MAP), ValueError, r"must end in \.png or \.npy; got"),
            ("a.png", MAP + 0.5, ValueError, "labels must hold whole numbers; got 0.5"),
            ("a.png", torch.full((2, 2), 0.5), ValueError, "labels must hold whole numbers; got 0.5"),
            ("a.png", None, TypeError, "labels must"),
            *(("a.png", torch.zeros(s).long(), ValueError, "labels must have") for s in ((1, 2, 2), (0, 2))),
            ("a.npy", torch.tensor([[-2]]), ValueError, "labels must hold non-negative ids; got -2"),
            *((f"no/{n}", torch.from_numpy(MAP), FileNotFoundError, "no does not exist") for n in ("a.png", "a.npy")),
        ],
    )
    def test_bad_arguments(self, tmp_path: Path, name: str, labels: Any, error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            save_labels(tmp_path / name, labels)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "highest", "message"),
    [("a.png", 1 << 24, "must be at most 16777215; got 16777216"), ("a.npy", 1, "path must end in .png; got")],
)
def test_ids_that_no_colour_can_be(tmp_path: Path, name: str, highest: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        save_labels(tmp_path / name, torch.tensor([[highest]]), rgb_ids=True)


def test_colours_that_are_no_ids(tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", np.full((4, 4, 4), 9, np.uint8))
    with pytest.raises(ValueError, match="must be RGB of 8 bits; got 4 channels of uint8"):
        load_labels(path, rgb_ids=True)
