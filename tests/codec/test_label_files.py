"""Label maps to bytes and back."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kcgs.codec import decode_labels, encode_labels
from kcgs.codec.labels import pixels
from kcgs.data import load_labels

from .conftest import make_labels

DTYPES = (torch.bool, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.uint32, torch.int32, torch.int64)


def roundtrip(labels: Any) -> bytes:
    labels = torch.as_tensor(labels)
    data = encode_labels(labels)
    decoded = decode_labels(data)
    assert decoded.dtype == labels.dtype and torch.equal(decoded.long(), labels.long())
    return data


class TestEncodeLabels:
    @settings(max_examples=20)
    @given(st.data())
    def test_roundtrip(self, data: st.DataObject) -> None:
        height, width = data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24))
        rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
        ids = data.draw(st.lists(st.integers(0, 1 << 62), min_size=1, max_size=12, unique=True))
        scale = data.draw(st.integers(1, 8))
        coarse = rng.choice(np.array(ids), (-(-height // scale), -(-width // scale)))
        roundtrip(np.kron(coarse, np.ones((scale, scale), np.int64))[:height, :width])

    @pytest.mark.parametrize("dtype", DTYPES)
    def test_types_and_sizes(self, dtype: torch.dtype) -> None:
        highest = 1 if dtype == torch.bool else min(torch.iinfo(dtype).max, 1 << 62)
        for size in ((1, 1), (1, 300), (300, 1), (9, 8)):
            labels = np.random.default_rng(0).choice([0, highest // 2, highest], size)
            roundtrip(torch.from_numpy(labels).to(dtype))

    def test_numpy_arrays(self) -> None:
        array = make_labels(1).astype(np.uint16)
        assert torch.equal(decode_labels(encode_labels(array)), torch.from_numpy(array))
        assert encode_labels(array[:, ::-1]) == encode_labels(np.ascontiguousarray(array[:, ::-1]))

    def test_uint64(self) -> None:
        array = make_labels(1).astype(np.uint64) << np.uint64(40)
        for labels in (array, torch.from_numpy(array)):
            assert torch.equal(decode_labels(encode_labels(labels)), torch.from_numpy(array.astype(np.int64)))

    def test_all_labels_different(self) -> None:
        roundtrip(torch.arange(50 * 60).view(50, 60))
        roundtrip(np.random.default_rng(0).permutation(50 * 60).reshape(50, 60) * 400_000)

    @pytest.mark.parametrize(
        ("labels", "max_bytes"), [(np.arange(1 << 16)[None] // 2 % 2, 60), (np.full((480, 854), 1 << 24), 20)]
    )
    def test_regular_maps_take_few_bytes(self, labels: Any, max_bytes: int) -> None:
        assert len(roundtrip(labels)) <= max_bytes

    @pytest.mark.parametrize("regions", [2, 256])
    def test_noise(self, regions: int) -> None:
        labels = np.random.default_rng(1).integers(0, regions, (96, 96))
        assert len(roundtrip(labels)) < 1.001 * labels.size * np.log2(regions) / 8 + 30 + regions

    def test_ids_take_few_bytes(self) -> None:
        mask = make_labels(0, count=2)
        assert len(roundtrip(mask * 255)) <= len(roundtrip(mask)) + 1
        labels = make_labels(0, count=9)
        order = np.random.RandomState(0).permutation(9)
        assert len(encode_labels(order[labels])) <= len(encode_labels(labels)) + 9

    @pytest.mark.parametrize("limit", ["MAX_CODED", "MAX_EXPLICIT"])
    def test_work_is_bounded(self, limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """A map that takes too long to decode is written as noise, and refused where it is not."""
        specks = np.random.default_rng(0).random((80, 120))
        labels = np.where(specks < 0.02, (specks * 300).astype(np.int64), np.arange(120) // 18)
        data = roundtrip(labels)
        monkeypatch.setattr(pixels, limit, 50)
        with pytest.raises(pixels.WorkLimitError, match="data must"):
            decode_labels(data)
        assert len(roundtrip(labels)) > len(data)

    def test_golden(self) -> None:
        labels = make_labels(7, (96, 128), 9) * 3
        data = encode_labels(labels)
        assert data == encode_labels(labels.copy())
        assert (len(data), zlib.crc32(data)) == (103, 3363245403)

    @pytest.mark.parametrize(
        ("pattern", "step", "share"), [("DAVIS/Annotations/480p/*/00000.png", 18, 0.285), ("bsds/*/mask.png", 6, 0.3)]
    )
    def test_share_of_webp(self, data_root: Path, pattern: str, step: int, share: float) -> None:
        """Beside lossless WebP; the network was trained on other maps, of other images."""
        from benchmarks.labels import encode_webp, region_numbers

        maps = [load_labels(path) for path in sorted(data_root.glob(pattern))[::step]]
        webp_bytes = sum(len(encode_webp(region_numbers(labels.numpy()))) for labels in maps)
        assert maps and sum(len(encode_labels(labels)) for labels in maps) < share * webp_bytes

    @pytest.mark.parametrize(
        ("labels", "error", "match"),
        [
            ([[1]], TypeError, "a PIL image or a path; got list"),
            (torch.zeros(1, 3, 3).long(), ValueError, "labels must have 2 dimensions"),
            (torch.tensor([[-1]]), ValueError, "labels must hold non-negative ids"),
            (np.full((3, 3), 1 << 63, np.uint64), ValueError, r"must hold ids below 2\*\*63; got 9223372036854775808"),
            (torch.zeros(1, (1 << 20) + 1, dtype=torch.uint8), ValueError, "pixels per side of labels must be in"),
        ],
    )
    def test_wrong_labels(self, labels: Any, error: type[Exception], match: str) -> None:
        with pytest.raises(error, match=match):
            encode_labels(labels)
