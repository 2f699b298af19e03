"""Label maps as files of their own: nothing lost, nothing trusted, and what the command line makes of them."""

from __future__ import annotations

import json
import random
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from kcgs import load
from kcgs.cli import main
from kcgs.codec import CodecError, decode, decode_labels, encode_labels
from kcgs.codec.labels import coding
from kcgs.codec.labels.coding import turned
from kcgs.codec.labels.ids import _code_regions
from kcgs.codec.rangecoder import Writer
from kcgs.data import load_labels, save_labels

from .test_file import damaged
from .test_labels import shapes

DTYPES = (torch.bool, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.uint32, torch.int32, torch.int64)


def opened(path: Path | str) -> Image.Image:
    with Image.open(path) as image:
        image.load()
        return image


def roundtrip(labels: Tensor) -> bytes:
    data = encode_labels(labels)
    found = decode_labels(data)
    assert found.dtype == labels.dtype and torch.equal(found.long(), labels.long())
    return data


class TestLossless:
    @settings(max_examples=80)
    @given(st.data())
    def test_any_map_comes_back(self, data: st.DataObject) -> None:
        height, width = data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24))
        rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
        ids = data.draw(st.lists(st.integers(0, 1 << 24), min_size=1, max_size=12, unique=True))
        scale = data.draw(st.integers(1, 8))
        coarse = rng.choice(np.array(ids), (-(-height // scale), -(-width // scale)))
        roundtrip(torch.from_numpy(np.kron(coarse, np.ones((scale, scale), np.int64))[:height, :width]))

    @pytest.mark.parametrize("dtype", DTYPES)
    @pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (9, 8)])
    def test_types_and_sizes(self, size: tuple[int, int], dtype: torch.dtype) -> None:
        most = 1 if dtype == torch.bool else min(torch.iinfo(dtype).max, 1 << 62)
        labels = torch.from_numpy(np.random.default_rng(0).choice([0, most // 2, most], size))
        roundtrip(labels.to(dtype))

    def test_numpy_arrays(self) -> None:
        array = shapes(1).astype(np.uint16)
        assert torch.equal(decode_labels(encode_labels(array)), torch.from_numpy(array))
        assert encode_labels(array[:, ::-1]) == encode_labels(np.ascontiguousarray(array[:, ::-1]))

    @pytest.mark.parametrize(("height", "most"), [(1, 60), (3, 120)])
    def test_wide(self, height: int, most: int) -> None:
        """A row is written as far as it is read, so that its changes do not cost its width each."""
        labels = (torch.arange(1 << 18) // 2 % 2).expand(height, -1)
        assert len(roundtrip(labels.contiguous())) < most

    def test_uint64(self) -> None:
        array = shapes(1).astype(np.uint64) << np.uint64(40)
        for labels in (array, torch.from_numpy(array)):
            assert torch.equal(decode_labels(encode_labels(labels)), torch.from_numpy(array.astype(np.int64)))

    def test_all_pixels_different(self) -> None:
        roundtrip(torch.arange(70 * 90).view(70, 90))
        roundtrip(torch.randperm(70 * 90, generator=torch.Generator().manual_seed(0)).view(70, 90) * 2_600)

    @pytest.mark.parametrize(("region", "most"), [(0, 16), (255, 17), (1 << 24, 20)])
    def test_one_region(self, region: int, most: int) -> None:
        assert len(roundtrip(torch.full((480, 854), region))) <= most

    def test_noise(self) -> None:
        labels = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (96, 96)))
        assert len(roundtrip(labels)) < 1.001 * labels.numel() + 256  # their order

    @pytest.mark.parametrize("turn", range(8))
    def test_turned(self, turn: int) -> None:
        labels = np.arange(6).reshape(2, 3)
        assert np.array_equal(turned(turned(labels, turn), turn, back=True), labels)
        corner = {0: 0, 1: 2, 2: 3, 3: 5, 4: 0, 5: 3, 6: 2, 7: 5}[turn]
        assert turned(labels, turn)[0, 0] == corner

    def test_ids_cost_little(self) -> None:
        # 0 and 255 as 0 and 1; any order of ids less than a byte for each
        mask = shapes(0, count=2)
        assert len(roundtrip(torch.from_numpy(mask * 255))) <= len(roundtrip(torch.from_numpy(mask))) + 1
        labels = shapes(0, count=9)
        order = np.random.RandomState(0).permutation(9)
        assert len(encode_labels(order[labels])) <= len(encode_labels(labels)) + 9

    def test_golden(self) -> None:
        labels = shapes(7, (96, 128), 9) * 3
        data = encode_labels(labels)
        assert data == encode_labels(labels.copy())
        assert (len(data), zlib.crc32(data)) == (103, 3363245403)


class TestRefused:
    @pytest.mark.parametrize(
        ("labels", "error", "words"),
        [
            (torch.zeros(3, 3), TypeError, "labels must have an integer dtype"),
            ([[1]], TypeError, "labels must be a Tensor; got list"),
            (torch.zeros(1, 3, 3).long(), ValueError, "labels must have 2 dimensions"),
            (torch.zeros(0, 3).long(), ValueError, "labels must have at least one pixel"),
            (torch.tensor([[-1]]), ValueError, "labels must hold non-negative ids"),
            (np.full((3, 3), 1 << 63, np.uint64), ValueError, r"must hold ids below 2\*\*63; got 9223372036854775808"),
            (torch.zeros(1, (1 << 20) + 1, dtype=torch.uint8), ValueError, "pixels per side of labels must be in"),
        ],
    )
    def test_no_label_map(self, labels: Any, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            encode_labels(labels)

    def test_no_file_of_a_map(self) -> None:
        with pytest.raises(TypeError, match="data must be bytes"):
            decode_labels("kcgm")  # type: ignore[arg-type]
        for data, words in {b"": "got b''", b"kcgs\1 and so on": "a scene, which kcgs.codec.decode reads"}.items():
            with pytest.raises(CodecError, match=f"data must be a label map.*{words}"):
                decode_labels(data)

    @pytest.mark.parametrize("length", [4, 6, 7])
    def test_beginnings(self, length: int) -> None:
        with pytest.raises(CodecError, match="the file is damaged or ends early"):
            decode_labels(encode_labels(shapes(0))[:length])

    def test_scenes_are_told_from_maps(self, tmp_path: Path) -> None:
        (tmp_path / "mask.kcgs").write_bytes(encode_labels(shapes(0)))
        with pytest.raises(ValueError, match=r"cannot load .*mask.kcgs: it is a label map, no scene: .*decode_labels"):
            load(tmp_path / "mask.kcgs")
        with pytest.raises(CodecError, match="it is a label map"):
            decode((tmp_path / "mask.kcgs").read_bytes())


def forged(form: int, numbers: bytes, stream: bytes) -> bytes:
    content = b"kcgm" + bytes([form]) + numbers + stream
    return content + zlib.crc32(content).to_bytes(4, "big")


class TestDamage:
    def test_two_thousand(self) -> None:
        """No damage goes unseen."""
        generator = random.Random(0)
        whole = [encode_labels(shapes(seed, (48, 64), 5) * 7) for seed in range(3)]
        for trial in range(2_000):
            data = damaged(whole[trial % 3], generator)
            if data != whole[trial % 3]:
                with pytest.raises(CodecError):
                    decode_labels(data)

    def test_every_cut_is_refused(self) -> None:
        data = encode_labels(shapes(0, (48, 64)))
        for length in range(len(data)):
            with pytest.raises(CodecError):
                decode_labels(data[:length])

    def test_right_checksums(self) -> None:
        """What decodes is a map of the size and type that the file names."""
        generator, sound = random.Random(1), 0
        streams = [encode_labels(shapes(seed, (48, 64), 5))[7:-4] for seed in range(3)]
        for trial in range(300):
            form = generator.randrange(64)
            try:
                found = decode_labels(forged(form, b"\x30\x40", damaged(streams[trial % 3], generator)))
            except CodecError as error:
                assert str(error)
                continue
            sound += 1
            assert found.shape == (48, 64) and found.dtype == DTYPES[form >> 3] and found.long().min() >= 0
        assert sound > 20

    @pytest.mark.parametrize(
        ("form", "numbers", "words"),
        [
            (64, b"\1\1", "its version must be 1; got 2"),
            (0, b"\0\1", r"height must be in \[1, 1048576\]; got 0"),
            (0, b"\x80\x80\x40\x80\x80\x40", "at most 67108864 pixels; got 1048576 x 1048576"),
            (0, b"\1", "the file ends early"),
        ],
    )
    def test_headers(self, form: int, numbers: bytes, words: str) -> None:
        with pytest.raises(CodecError, match=words):
            decode_labels(forged(form, numbers, b""))

    def test_ids_beyond_the_type(self) -> None:
        data = encode_labels(shapes(0) * 200)
        low = forged(data[4] % 8 + 8, data[5:8], data[8:-4])
        with pytest.raises(CodecError, match=r"ids of uint8 must be at most 255; got 1000"):
            decode_labels(low)

    def test_many_regions_of_few_bytes(self) -> None:
        """Neither time nor memory for what a few bytes cannot hold."""
        writer = Writer()
        _code_regions(writer, 1 << 20, 1 << 20)
        with pytest.raises(CodecError, match="at most 262145 regions; got 1048576"):
            decode_labels(forged(0, b"\x80\x10\x80\x10", writer.finish()))

    def test_many_regions(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(coding, "MOST_ESCAPES", 20)  # beyond these, maps are noise
        roundtrip(torch.arange(80 * 90).view(80, 90))


class TestColors:
    def test_ids_as_colors(self, tmp_path: Path) -> None:
        labels = torch.tensor([[0, 255, 256], [65_536, 70_000, (1 << 24) - 1]])
        save_labels(tmp_path / "a.png", labels, rgb_ids=True)
        assert opened(tmp_path / "a.png").getpixel((1, 1)) == (70_000 % 256, 70_000 // 256 % 256, 1)
        assert torch.equal(load_labels(tmp_path / "a.png", rgb_ids=True), labels)
        save_labels(tmp_path / "b.png", labels % 200)
        assert torch.equal(load_labels(tmp_path / "b.png", rgb_ids=True), labels % 200)

    def test_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="must be at most 16777215; got 16777216"):
            save_labels(tmp_path / "a.png", torch.tensor([[1 << 24]]), rgb_ids=True)
        with pytest.raises(ValueError, match="path must end in .png; got"):
            save_labels(tmp_path / "a.npy", torch.tensor([[1]]), rgb_ids=True)
        Image.fromarray(np.full((4, 4, 4), 9, np.uint8)).save(tmp_path / "a.png")
        with pytest.raises(ValueError, match="must be RGB of 8 bits; got 4 channels of uint8"):
            load_labels(tmp_path / "a.png", rgb_ids=True)


class TestCommands:
    @pytest.fixture
    def run(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Any:
        monkeypatch.chdir(tmp_path)

        def run(*arguments: str, code: int = 0, err: bool = False) -> str:
            monkeypatch.setattr("sys.argv", ["kcgs", *arguments])
            with pytest.raises(SystemExit) as ended:
                main()
            captured = capsys.readouterr()
            assert (ended.value.code or 0) == code, captured.err
            return captured.err if code or err else captured.out

        return run

    @pytest.mark.parametrize(
        ("times", "suffix", "mode"),
        [(1, "png", "P"), (300, "png", "I;16"), (70_000, "png", "RGB"), (1 << 40, "npy", "")],
    )
    def test_there_and_back(self, run: Any, times: int, suffix: str, mode: str) -> None:
        labels = torch.from_numpy(shapes(2)) * times
        save_labels(f"mask.{suffix}", labels, rgb_ids=mode == "RGB")
        facts = json.loads(run("encode", f"mask.{suffix}", "-o", "mask.kcgs", "--json"))
        assert facts["bytes"] == Path("mask.kcgs").stat().st_size < 400
        run("decode", "mask.kcgs", "-o", f"again.{suffix}")
        Path("mask.kcgs").rename("mask.other")
        run("decode", "mask.other", "-o", f"other.{suffix.upper()}")
        assert Path(f"other.{suffix.upper()}").read_bytes() == Path(f"again.{suffix}").read_bytes()
        Path("mask.other").rename("mask.kcgs")
        assert torch.equal(load_labels(f"again.{suffix}", rgb_ids=True), labels)
        assert not mode or opened("again.png").mode == mode
        info = json.loads(run("info", "mask.kcgs", "--json"))
        assert info == facts
        assert (info["holds"], info["regions"], info["largest_id"]) == ("label map", 6, 5 * times)
        assert "label map" in run("info", "mask.kcgs")

    def test_wrong_use(self, run: Any) -> None:
        save_labels("mask.png", torch.from_numpy(shapes(2)))
        run("encode", "mask.png", "-o", "mask.kcgs")
        assert "'--quality': must be left out with a label map" in run(
            "encode", "mask.png", "-o", "b.kcgs", "--quality", "40", code=2
        )
        assert "'--bytes': must be left out" in run("decode", "mask.kcgs", "-o", "b.png", "--bytes", "5", code=2)
        assert ".png or .npy" in run("decode", "mask.kcgs", "-o", "b.jpg", code=2)
        assert "kcgs decode writes it" in run("encode", "mask.kcgs", "-o", "b.kcgs", code=1)
        assert "it is a label map, no scene" in run("render", "mask.kcgs", "-o", "b.png", code=1)
        assert "No such file or directory: none.png" in run("encode", "none.png", "-o", "b.kcgs", code=1)
        Path("mask.kcgs").write_bytes(Path("mask.kcgs").read_bytes()[:-1])
        for command in (["info", "mask.kcgs"], ["decode", "mask.kcgs", "-o", "b.png"]):
            assert "the file is damaged" in run(*command, code=1)
        assert not Path("b.png").exists() and not Path("b.kcgs").exists()


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)])
def test_size(data_root: Path, every: int) -> None:
    """Of the bytes of lossless WebP; the network was trained on other maps, of other images."""
    from benchmarks.labels import encode_webp, region_numbers

    for pattern, most in {"DAVIS/Annotations/480p/*/00000.png": 0.285, "bsds/*/mask.png": 0.3}.items():
        maps = [load_labels(path) for path in sorted(data_root.glob(pattern))[::every]]
        assert maps and sum(len(encode_labels(m)) for m in maps) < most * sum(
            len(encode_webp(region_numbers(m.numpy()))) for m in maps
        )
