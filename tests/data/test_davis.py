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
        with pytest.raises(ValueError, match="no sequence 'cows'; there are 2: bear, dog"):
            davis["cows"]

    def test_the_list_is_a_copy(self, root: Path) -> None:
        davis = Davis(root)
        davis.sequences.clear()
        assert len(davis) == 3

    def test_sequence(self, root: Path) -> None:
        add_frame(root, "dog", frame=12)
        dog = Davis(root).sequence("dog")
        assert (dog.name, len(dog), repr(dog)) == ("dog", 3, "DavisSequence('dog', 3 frames)")
        for _ in range(2):
            frames = list(dog)
            assert all(isinstance(frame, DavisFrame) and frame.sequence == "dog" for frame in frames)
            assert [round(float(frame.image[0].mean()) * 25.5) for frame in frames] == [0, 7, 12]
        assert torch.equal(dog[-1].image, frames[2].image)
        assert len(dog[1:]) == 2 and torch.equal(dog[1:][0].image, frames[1].image)
        with pytest.raises(ValueError, match="no sequence 'cat'"):
            Davis(root).sequence("cat")
        (root / "Annotations" / "480p" / "dog" / "00007.png").unlink()
        with pytest.raises(FileNotFoundError, match="frame 7 of sequence 'dog' lacks"):
            list(dog)

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
        with pytest.raises(FileNotFoundError, match=rf"sequence 'cows' lacks .*{tree}.*cows.00000\.{suffix}"):
            davis["cows"]

    def test_missing_frame(self, root: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"frame 3 of sequence 'bear' lacks .*00003\.jpg"):
            Davis(root, frame=3)[0]

    def test_sizes_differ(self, root: Path) -> None:
        Image.new("L", (6, 4)).save(root / "Annotations" / "480p" / "dog" / "00000.png")
        with pytest.raises(ValueError, match=r"sequence 'dog'.*got \(8, 12\).*and \(4, 6\)"):
            Davis(root)["dog"]

    def test_wrong_root(self, tmp_path: Path) -> None:
        for root in (tmp_path, tmp_path / "nowhere"):
            with pytest.raises(FileNotFoundError, match=r"root must hold JPEGImages.*Annotations"):
                Davis(root)

    def test_no_common_sequence(self, tmp_path: Path) -> None:
        (tmp_path / "JPEGImages" / "480p" / "dog").mkdir(parents=True)
        (tmp_path / "Annotations" / "480p" / "cat").mkdir(parents=True)
        with pytest.raises(FileNotFoundError, match="no sequence has a folder in both"):
            Davis(tmp_path)

    def test_unknown_sequence_lists_a_few(self, root: Path) -> None:
        for k in range(9):
            add_frame(root, f"s{k}")
        with pytest.raises(ValueError, match=r"no sequence 'cat'; there are 12: bear, cows, dog, s0, s1, \.\.\."):
            Davis(root, sequences=["cat"])

    def test_one_name_is_no_list(self, root: Path) -> None:
        with pytest.raises(TypeError, match="sequences must be a list of names; got the string 'dog'"):
            Davis(root, sequences="dog")

    @pytest.mark.parametrize("position", [3, -4])
    def test_position_out_of_range(self, root: Path, position: int) -> None:
        with pytest.raises(IndexError, match=f"there are 3 sequences; got position {position}"):
            Davis(root)[position]

    @pytest.mark.parametrize("key", [1.0, None, True])
    def test_key_type(self, root: Path, key: Any) -> None:
        with pytest.raises(TypeError, match="by position or sequence name"):
            Davis(root)[key]

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
