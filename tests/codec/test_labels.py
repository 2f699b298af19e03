"""Label maps as bytes: nothing lost, nothing wasted, nothing trusted."""

from __future__ import annotations

import hashlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from kcgs.codec import CodecError
from kcgs.codec.labels import coding, decode_labels, encode_labels
from kcgs.codec.labels.contexts import CLIP, SQUASH
from kcgs.codec.rangecoder import Reader, Writer
from kcgs.data import load_labels

Labels = NDArray[np.int64]


def roundtrip(labels: Labels) -> int:
    data = encode_labels(labels)
    height, width = labels.shape
    assert np.array_equal(decode_labels(data, height, width, max_regions=labels.size), labels)
    return len(data)


def shapes(seed: int, size: tuple[int, int] = (120, 160), count: int = 6) -> Labels:
    """Draw overlapping discs, from integers alone."""
    rng = np.random.RandomState(seed)
    y, x = np.mgrid[: size[0], : size[1]]
    labels = np.zeros(size, np.int64)
    for region in range(1, count):
        cy, cx, radius = rng.randint(size[0]), rng.randint(size[1]), rng.randint(5, 40)
        labels[(y - cy) ** 2 + (x - cx) ** 2 < radius**2] = region
    return labels


def webp_bytes(labels: Labels) -> int:
    file = BytesIO()
    image = Image.fromarray(labels.astype(np.uint8))
    image.save(file, "WEBP", lossless=True, quality=100, method=6, exact=True)
    return len(file.getvalue())


class TestLossless:
    @settings(max_examples=60)
    @given(st.data())
    def test_any_map_comes_back(self, data: st.DataObject) -> None:
        height, width = data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24))
        rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
        ids = data.draw(st.lists(st.integers(0, 1 << 31), min_size=1, max_size=12, unique=True))
        scale = data.draw(st.integers(1, 8))
        coarse = rng.choice(np.array(ids), (-(-height // scale), -(-width // scale)))
        roundtrip(np.kron(coarse, np.ones((scale, scale), np.int64))[:height, :width])

    @pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (2, 2), (3, 500), (500, 3), (9, 8)])
    @pytest.mark.parametrize("regions", [2, 3, 40])
    def test_narrow_maps(self, size: tuple[int, int], regions: int) -> None:
        rng = np.random.default_rng(0)
        roundtrip(rng.integers(0, regions, size))
        roundtrip(np.sort(rng.integers(0, regions, size), axis=None).reshape(size))

    @pytest.mark.parametrize("regions", [2, 3, 16, 256])
    def test_noise_costs_little_more_than_its_bits(self, regions: int) -> None:
        labels = np.random.default_rng(1).integers(0, regions, (96, 96))
        assert roundtrip(labels) < 1.001 * labels.size * np.log2(regions) / 8 + 3 * regions

    def test_thousands_of_regions(self) -> None:
        labels = np.arange(5000).reshape(50, 100)
        roundtrip(labels)
        roundtrip(np.random.default_rng(0).permutation(5000).reshape(50, 100) * 400_000)

    @pytest.mark.parametrize("seed", range(4))
    def test_regions_of_one_pixel(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        labels = np.zeros((80, 90), np.int64)
        labels[rng.integers(0, 80, 30), rng.integers(0, 90, 30)] = np.arange(1, 31)
        roundtrip(labels)

    def test_ids_up_to_the_largest(self) -> None:
        labels = shapes(3)
        roundtrip(labels + (1 << 31))
        roundtrip(labels * (1 << 60))

    @pytest.mark.parametrize(("region", "most"), [(0, 0), (5, 2), (255, 2)])
    def test_one_region(self, region: int, most: int) -> None:
        assert roundtrip(np.full((480, 854), region, np.int64)) <= most


class TestStream:
    def test_same_map_same_bytes(self) -> None:
        assert encode_labels(shapes(0)) == encode_labels(shapes(0).copy())

    def test_golden(self) -> None:
        data = encode_labels(shapes(7, (96, 128), 9) * 3)
        assert (len(data), hashlib.sha256(data).hexdigest()[:16]) == (97, "9de774e00b30b698")

    def test_too_many_regions(self) -> None:
        data = encode_labels(shapes(0))
        with pytest.raises(CodecError, match="at most 3 regions; got 5"):
            decode_labels(data, 120, 160, max_regions=3)

    def test_broken_streams(self) -> None:
        rng = np.random.default_rng(0)
        whole = [encode_labels(shapes(seed, (48, 64), 5) * 7) for seed in range(3)]
        for trial in range(300):
            data = bytearray(whole[trial % 3])
            if trial % 2:
                data = data[: rng.integers(0, len(data))]
            else:
                for at in rng.integers(0, len(data), rng.integers(1, 4)):
                    data[at] = rng.integers(0, 256)
            try:
                labels = decode_labels(bytes(data), 48, 64, max_regions=100)
            except CodecError:
                continue
            assert labels.shape == (48, 64) and labels.min() >= 0

    @pytest.mark.parametrize("data", [b"\xff" * 50, bytes(range(200)), b"\xaa" * 31])
    def test_garbage(self, data: bytes) -> None:
        try:
            decode_labels(data, 64, 64, max_regions=1000)
        except CodecError as error:
            assert "data must" in str(error)

    @settings(max_examples=100)
    @given(st.lists(st.tuples(st.integers(1, 65535), st.booleans()), max_size=200))
    def test_end_of_stream(self, symbols: list[tuple[int, bool]]) -> None:
        chances = np.array([chance / 65536 for chance, _ in symbols])
        values = np.array([value for _, value in symbols], np.int32)
        writer = Writer()
        writer.bits(chances, values)
        data = writer.finish()
        cost = -np.log2(np.where(values == 1, chances, 1 - chances)).sum()
        assert len(data) <= cost / 8 + 1.1
        assert np.array_equal(Reader(data).bits(chances, values), values)

    def test_table_does_not_hang_on_the_last_digit_of_exp(self) -> None:
        exact = 65536 / (1 + np.exp(-np.arange(-CLIP, CLIP + 1) / 256))
        assert np.array_equal(SQUASH, np.rint(exact))
        assert np.abs(np.abs(exact - np.floor(exact)) - 0.5).min() > 1e-6


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)])
class TestSize:
    """Against lossless WebP; the network was trained on other maps, of other images."""

    def ratio(self, paths: list[Path]) -> float:
        assert paths
        maps = [load_labels(path).numpy() for path in paths]
        return float(np.mean([len(encode_labels(labels)) / webp_bytes(labels) for labels in maps]))

    def test_davis(self, data_root: Path, every: int) -> None:
        assert self.ratio(sorted(data_root.glob("DAVIS/Annotations/480p/*/00000.png"))[::every]) < 0.285

    def test_bsds(self, data_root: Path, every: int) -> None:
        assert self.ratio(sorted(data_root.glob("bsds/*/mask.png"))[::every]) < 0.32


class TestWork:
    """What takes minutes is written plainly, and refused where it is not."""

    @pytest.mark.parametrize("limit", ["_MOST_ASKED", "MOST_ESCAPES"])
    def test_bounded(self, limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
        specks = np.random.default_rng(0).random((80, 120))
        labels = np.where(specks < 0.02, (specks * 300).astype(np.int64), np.arange(120) // 18)
        modelled = encode_labels(labels)
        monkeypatch.setattr(coding, limit, 50)
        with pytest.raises(CodecError, match="data must"):
            decode_labels(modelled, 80, 120, max_regions=7)
        plain = encode_labels(labels)
        assert len(plain) > len(modelled)
        assert (decode_labels(plain, 80, 120, max_regions=7) == labels).all()
