"""``Davis`` over a small tree of its layout, and over real frames where they are."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from kcgs.data import Davis, DavisFrame


def add_frame(root: Path, sequence: str, frame: int = 0, *, resolution: str = "480p", year: int = 2016) -> None:
    images = root / "JPEGImages" / resolution / sequence
    annotations = root / "Annotations" / resolution / sequence
    for folder in (images, annotations):
        folder.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (12, 8), (10 * frame, 100, 200)).save(images / f"{frame:05d}.jpg", quality=95)
    mask = np.zeros((8, 12), np.uint8)
    mask[2:5, 3:9] = 255 if year == 2016 else 1
    stored = Image.fromarray(mask)
    if year == 2017:
        mask[5:7, 3:9] = 2
        stored = Image.fromarray(mask)
        stored.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    stored.save(annotations / f"{frame:05d}.png")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("dog", "bear", "cows"):
        add_frame(tmp_path, name)
        add_frame(tmp_path, name, frame=7)
    return tmp_path


class TestDavis:
    def test_listing(self, root: Path) -> None:
        (root / "JPEGImages" / "480p" / "lonely").mkdir()
        (root / "Annotations" / "480p" / "other").mkdir()
        (root / "Annotations" / "480p" / "readme.txt").touch()
        (root / "JPEGImages" / "480p" / "readme.txt").touch()
        davis = Davis(str(root))
        assert davis.sequences == ["bear", "cows", "dog"]
        assert len(davis) == 3

    def test_item(self, root: Path) -> None:
        frame = Davis(root)["cows"]
        assert isinstance(frame, DavisFrame)
        sequence, image, labels = frame
        assert sequence == "cows"
        assert image.shape == (3, 8, 12)
        assert image.dtype == torch.float32
        assert labels.dtype == torch.int64
        assert labels.unique().tolist() == [0, 255]
        assert (labels[2:5, 3:9] == 255).all()

    def test_indices(self, root: Path) -> None:
        davis = Davis(root)
        assert [davis[k].sequence for k in (0, 1, 2, -1, -3)] == ["bear", "cows", "dog", "dog", "bear"]
        assert [frame.sequence for frame in davis] == davis.sequences
        assert [frame.sequence for frame in davis] == davis.sequences  # a second pass starts anew

    def test_palette_annotations(self, tmp_path: Path) -> None:
        add_frame(tmp_path, "dog", year=2017)
        assert Davis(tmp_path)[0].labels.unique().tolist() == [0, 1, 2]

    def test_selection(self, root: Path) -> None:
        davis = Davis(root, sequences=["dog", "bear", "dog"])
        assert davis.sequences == ["bear", "dog"]
        with pytest.raises(ValueError, match="sequences must be among bear, cows, dog; got 'cat'"):
            Davis(root, sequences=["cat"])

    def test_another_frame(self, root: Path) -> None:
        first, later = Davis(root)[0].image, Davis(root, frame=7)[0].image
        assert (later - first).abs().max() > 0.2

    def test_another_resolution(self, tmp_path: Path) -> None:
        add_frame(tmp_path, "dog", resolution="Full-Resolution")
        assert Davis(tmp_path, resolution="Full-Resolution").sequences == ["dog"]
        with pytest.raises(FileNotFoundError, match="480p"):
            Davis(tmp_path)

    @pytest.mark.parametrize("tree", ["JPEGImages", "Annotations"])
    def test_missing_file_is_named_on_access(self, root: Path, tree: str) -> None:
        suffix = {"JPEGImages": "jpg", "Annotations": "png"}[tree]
        (root / tree / "480p" / "cows" / f"00000.{suffix}").unlink()
        davis = Davis(root)
        assert "cows" in davis.sequences
        with pytest.raises(FileNotFoundError, match=rf"{tree}.*cows.00000\.{suffix}"):
            davis["cows"]

    def test_missing_frame(self, root: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"bear.00003\.jpg"):
            Davis(root, frame=3)[0]

    def test_wrong_root(self, tmp_path: Path) -> None:
        for root in (tmp_path, tmp_path / "nowhere"):
            with pytest.raises(FileNotFoundError, match=r"root must hold JPEGImages.*Annotations"):
                Davis(root)

    def test_frame_argument(self, root: Path) -> None:
        with pytest.raises(ValueError, match="frame must be at least 0; got -1"):
            Davis(root, frame=-1)
        wrong: Any = "0"
        with pytest.raises(TypeError, match="frame must be an integer"):
            Davis(root, frame=wrong)


class TestRealData:
    def test_first_frames(self, data_root: Path) -> None:
        if not (data_root / "DAVIS").is_dir():
            pytest.skip(f"no DAVIS folder in {data_root}")
        davis = Davis(data_root / "DAVIS", sequences=["blackswan", "cows", "train"])
        for frame in davis:
            assert frame.image.shape == (3, 480, 854)
            assert frame.labels.unique().tolist() == [0, 255]
            assert 0.01 < (frame.labels == 255).float().mean() < 0.5
