"""``Davis`` over a small tree of its layout, and over real frames where they are."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from kcgs.data import Davis, DavisFrame

MASK = np.zeros((8, 12), np.uint8)
MASK[2:5, 3:9], MASK[5:7, 3:9] = 1, 2


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Make two sequences of 2016, one of 2017 with a palette, and what is no sequence."""
    for tree in ("JPEGImages/480p", "Annotations/480p"):
        for name in ("dog", "bear", "cows"):
            (tmp_path / tree / name).mkdir(parents=True)
        (tmp_path / tree / "readme.txt").touch()
    (tmp_path / "JPEGImages/480p/lonely").mkdir()
    for name in ("dog", "bear", "cows"):
        Image.new("RGB", (12, 8), "teal").save(tmp_path / f"JPEGImages/480p/{name}/00000.jpg")
        mask = Image.fromarray(MASK if name == "cows" else (MASK > 0).astype(np.uint8) * 255)
        if name == "cows":
            mask.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
        mask.save(tmp_path / f"Annotations/480p/{name}/00000.png")
    return tmp_path


class TestDavis:
    def test_sequences(self, root: Path) -> None:
        davis = Davis(str(root))
        assert davis.sequences == ["bear", "cows", "dog"] and len(davis) == 3
        assert [davis[k].sequence for k in (0, 1, 2, -1, -3)] == ["bear", "cows", "dog", "dog", "bear"]
        assert [frame.sequence for frame in davis] == [frame.sequence for frame in davis] == davis.sequences

    def test_frames(self, root: Path) -> None:
        bear, cows = Davis(root)["bear"], Davis(root)["cows"]
        assert isinstance(bear, DavisFrame) and bear.sequence == "bear"
        assert bear.image.shape == (3, 8, 12) and bear.image.dtype == torch.float32
        assert torch.equal(bear.labels, torch.from_numpy(MASK > 0).long() * 255)
        assert torch.equal(cows.labels, torch.from_numpy(MASK).long())

    @pytest.mark.parametrize(("tree", "suffix"), [("JPEGImages", "jpg"), ("Annotations", "png")])
    def test_missing_file_is_named_on_access(self, root: Path, tree: str, suffix: str) -> None:
        (root / tree / "480p" / "cows" / f"00000.{suffix}").unlink()
        davis = Davis(root)
        with pytest.raises(FileNotFoundError, match=rf"{tree}.*cows.00000\.{suffix}"):
            davis["cows"]

    def test_bad_root(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"root must hold JPEGImages.*Annotations"):
            Davis(tmp_path)

    def test_real_data(self, data_root: Path) -> None:
        if not (data_root / "DAVIS").is_dir():
            pytest.skip(f"no DAVIS folder in {data_root}")
        davis = Davis(data_root / "DAVIS")
        for frame in (davis["blackswan"], davis["train"]):
            assert frame.image.shape == (3, 480, 854) and frame.labels.unique().tolist() == [0, 255]
