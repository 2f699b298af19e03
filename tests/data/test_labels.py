"""Label maps: what each kind of file means, round trips, colours."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
import tifffile
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from kcgs.data import colorize_labels, label_colors, load_labels, save_labels

MAP = np.array([[0, 1, 1, 5], [0, 3, 5, 5]], np.uint8)


def save_as(path: Path, image: Image.Image, **options: Any) -> Path:
    image.save(path, **options)
    return path


class TestLoad:
    def test_palette_index_is_the_label(self, tmp_path: Path) -> None:
        image = Image.fromarray(MAP)
        # Equal colours for different indices, as careless tools write them: the index must count.
        image.putpalette([9, 9, 9] * 6)
        labels = load_labels(save_as(tmp_path / "a.png", image))
        assert labels.dtype == torch.int64
        np.testing.assert_array_equal(labels, MAP)

    def test_palette_of_few_bits_with_transparency(self, tmp_path: Path) -> None:
        image = Image.fromarray(MAP)
        image.putpalette(list(range(18)))
        path = save_as(tmp_path / "a.png", image, bits=4, transparency=0)
        np.testing.assert_array_equal(load_labels(path), MAP)

    def test_binary_mask_keeps_0_and_255(self, tmp_path: Path) -> None:
        mask = (MAP > 2).astype(np.uint8) * 255
        labels = load_labels(save_as(tmp_path / "a.png", Image.fromarray(mask)))
        assert labels.unique().tolist() == [0, 255]
        np.testing.assert_array_equal(labels, mask)

    def test_one_bit(self, tmp_path: Path) -> None:
        labels = load_labels(save_as(tmp_path / "a.png", Image.fromarray(MAP > 2)))
        np.testing.assert_array_equal(labels, MAP > 2)

    def test_sixteen_bit_gray(self, tmp_path: Path) -> None:
        values = MAP.astype(np.uint16) * 9000
        for suffix in ("png", "tif"):
            path = save_as(tmp_path / f"a.{suffix}", Image.fromarray(values))
            np.testing.assert_array_equal(load_labels(path), values)

    @pytest.mark.parametrize("dtype", [np.int32, np.uint32, np.int16, np.int8])
    def test_integer_tiff(self, tmp_path: Path, dtype: type) -> None:
        tifffile.imwrite(tmp_path / "a.tif", MAP.astype(dtype))
        np.testing.assert_array_equal(load_labels(tmp_path / "a.tif"), MAP)

    @pytest.mark.parametrize("suffix", ["gif", "bmp", "tif"])
    def test_other_lossless_formats(self, tmp_path: Path, suffix: str) -> None:
        image = Image.fromarray(np.kron(MAP, np.ones((4, 4), np.uint8)))
        image.putpalette([v for k in range(6) for v in (k * 40, 255 - k * 40, 7)])
        options = {"gif": {"optimize": False}}.get(suffix, {})
        labels = load_labels(save_as(tmp_path / f"a.{suffix}", image, **options))
        np.testing.assert_array_equal(labels[::4, ::4], MAP)

    def test_colors_are_numbered_in_packed_order(self, tmp_path: Path) -> None:
        colors = np.array([[[255, 0, 0], [0, 0, 255]], [[0, 255, 0], [0, 0, 255]]], np.uint8)
        path = save_as(tmp_path / "a.png", Image.fromarray(colors))
        assert load_labels(path).tolist() == [[2, 0], [1, 0]]

    def test_invisible_colors_are_one_region(self, tmp_path: Path) -> None:
        colors = np.array([[[9, 9, 9, 0], [5, 5, 5, 0], [5, 5, 5, 255], [5, 5, 5, 128]]], np.uint8)
        path = save_as(tmp_path / "a.png", Image.fromarray(colors))
        assert load_labels(path).tolist() == [[0, 0, 2, 1]]

    def test_photo_is_refused(self, tmp_path: Path) -> None:
        path = save_as(tmp_path / "a.png", Image.fromarray(skimage.data.astronaut()))
        with pytest.raises(ValueError, match=r"at most 4096 distinct colours; got \d+ in .*a\.png"):
            load_labels(path)

    def test_4096_colors_are_accepted(self, tmp_path: Path) -> None:
        index = np.arange(4097)
        colors = np.stack([index >> 8, index & 255, 0 * index], axis=-1).astype(np.uint8)[None]
        labels = load_labels(save_as(tmp_path / "a.png", Image.fromarray(colors[:, :4096])))
        np.testing.assert_array_equal(labels[0], np.arange(4096))
        with pytest.raises(ValueError, match="got 4097"):
            load_labels(save_as(tmp_path / "b.png", Image.fromarray(colors)))

    @pytest.mark.parametrize(
        ("name", "options"),
        [("a.jpg", {}), ("a.webp", {"quality": 90}), ("a.tif", {"compression": "jpeg"}), ("a.png", {"format": "JPEG"})],
    )
    def test_lossy_files_are_refused(self, tmp_path: Path, name: str, options: dict[str, Any]) -> None:
        path = save_as(tmp_path / name, Image.fromarray(MAP).convert("RGB"), **options)
        with pytest.raises(ValueError, match=r"must be a label map in a lossless format .* got"):
            load_labels(path)

    def test_float_tiff_is_refused(self, tmp_path: Path) -> None:
        tifffile.imwrite(tmp_path / "a.tif", MAP.astype(np.float32) / 5)
        with pytest.raises(TypeError, match=r"a\.tif must have an integer dtype; got float32"):
            load_labels(tmp_path / "a.tif")

    def test_negative_tiff_is_refused(self, tmp_path: Path) -> None:
        tifffile.imwrite(tmp_path / "a.tif", MAP.astype(np.int16) - 1)
        with pytest.raises(ValueError, match=r"a\.tif must hold non-negative ids; got -1"):
            load_labels(tmp_path / "a.tif")

    def test_missing(self, tmp_path: Path) -> None:
        for name in ("none.png", "none.npy"):
            with pytest.raises(FileNotFoundError, match=name):
                load_labels(tmp_path / name)

    @pytest.mark.parametrize("name", ["a.png", "a.npy"])
    def test_no_image(self, tmp_path: Path, name: str) -> None:
        (tmp_path / name).write_bytes(b"text")
        with pytest.raises(ValueError, match=rf"cannot read .*{name}"):
            load_labels(tmp_path / name)


class TestNpy:
    @pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.uint64, np.int16, ">i4", bool])
    def test_integers_and_booleans(self, tmp_path: Path, dtype: Any) -> None:
        np.save(tmp_path / "a.npy", MAP.astype(dtype))
        labels = load_labels(tmp_path / "a.npy")
        assert labels.dtype == torch.int64
        np.testing.assert_array_equal(labels, MAP.astype(dtype))

    @pytest.mark.parametrize(
        ("array", "message"),
        [
            (MAP.astype(float), "must have an integer dtype; got float64"),
            (MAP.astype(np.int8) - 1, "must hold non-negative ids; got -1"),
            (np.full((2, 2), 2**63, np.uint64), r"must hold ids below 2\*\*63"),
            (MAP[None], r"must have 2 dimensions; got shape \(1, 2, 4\)"),
            (np.zeros((0, 3), int), r"must have at least one pixel; got shape \(0, 3\)"),
        ],
    )
    def test_other_arrays(self, tmp_path: Path, array: np.ndarray, message: str) -> None:
        np.save(tmp_path / "a.npy", array)
        with pytest.raises((ValueError, TypeError), match=message):
            load_labels(tmp_path / "a.npy")

    def test_pickles_are_never_loaded(self, tmp_path: Path) -> None:
        np.save(tmp_path / "a.npy", np.array([[{}]], object), allow_pickle=True)
        with pytest.raises(ValueError, match=r"cannot read .*allow_pickle=False"):
            load_labels(tmp_path / "a.npy")

    def test_truncated(self, tmp_path: Path) -> None:
        np.save(tmp_path / "a.npy", MAP)
        data = (tmp_path / "a.npy").read_bytes()
        (tmp_path / "a.npy").write_bytes(data[:-3])
        with pytest.raises(ValueError, match=r"cannot read .*a\.npy"):
            load_labels(tmp_path / "a.npy")


class TestSave:
    @settings(max_examples=40)
    @given(
        values=st.sampled_from([(".png", 255), (".png", 65535), (".npy", 2**62)]).flatmap(
            lambda kind: st.tuples(
                st.just(kind[0]),
                hnp.arrays(np.int64, hnp.array_shapes(min_dims=2, max_dims=2), elements=st.integers(0, kind[1])),
            )
        )
    )
    def test_round_trip(self, tmp_path: Path, values: tuple[str, np.ndarray]) -> None:
        suffix, array = values
        labels = torch.from_numpy(array)
        save_labels(tmp_path / f"a{suffix}", labels)
        assert torch.equal(load_labels(tmp_path / f"a{suffix}"), labels)

    @pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
    def test_integer_types(self, tmp_path: Path, dtype: torch.dtype) -> None:
        save_labels(tmp_path / "a.png", torch.from_numpy(MAP).to(dtype))
        np.testing.assert_array_equal(load_labels(tmp_path / "a.png"), MAP)

    def test_small_ids_are_an_eight_bit_palette_image(self, tmp_path: Path) -> None:
        save_labels(tmp_path / "a.png", torch.tensor([[0, 1, 255]]))
        with Image.open(tmp_path / "a.png") as image:
            assert image.mode == "P"
            assert np.asarray(image).tolist() == [[0, 1, 255]]
            colors = np.asarray(image.convert("RGB"))[0]
        assert len({tuple(color) for color in colors.tolist()}) == 3

    def test_large_ids_are_sixteen_bit_gray(self, tmp_path: Path) -> None:
        save_labels(tmp_path / "a.png", torch.tensor([[0, 256, 65535]]))
        assert (tmp_path / "a.png").read_bytes()[24:26] == bytes([16, 0])

    def test_ids_too_large_for_png(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"labels for a \.png must be at most 65535; got 65536"):
            save_labels(tmp_path / "a.png", torch.tensor([[65536]]))
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("name", ["a", "a.jpg", "a.tif"])
    def test_suffix(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(ValueError, match=r"path must end in \.png or \.npy; got"):
            save_labels(tmp_path / name, torch.from_numpy(MAP))

    @pytest.mark.parametrize("labels", [MAP.astype(float), torch.zeros(2, 2), None])
    def test_type(self, tmp_path: Path, labels: Any) -> None:
        with pytest.raises(TypeError, match="labels must"):
            save_labels(tmp_path / "a.png", labels)

    @pytest.mark.parametrize("shape", [(4,), (1, 2, 2), (0, 2)])
    def test_shape(self, tmp_path: Path, shape: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match="labels must have"):
            save_labels(tmp_path / "a.png", torch.zeros(shape, dtype=torch.int64))

    def test_negative(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="labels must hold non-negative ids; got -2"):
            save_labels(tmp_path / "a.npy", torch.tensor([[-2]]))

    def test_missing_folder(self, tmp_path: Path) -> None:
        for name in ("a.png", "a.npy"):
            with pytest.raises(FileNotFoundError, match=r"folder .*nowhere does not exist"):
                save_labels(tmp_path / "nowhere" / name, torch.from_numpy(MAP))


class TestColors:
    def test_range_and_prefix(self) -> None:
        colors = label_colors(5000)
        assert colors.dtype == torch.float32
        assert 0 <= colors.min() <= colors.max() <= 1
        assert torch.equal(label_colors(7), colors[:7])
        assert label_colors(0).shape == (0, 3)

    def test_distinct(self) -> None:
        levels = (label_colors(256) * 255).round().to(torch.uint8)
        assert len(levels.unique(dim=0)) == 256
        assert len(label_colors(4096).unique(dim=0)) == 4096

    def test_first_colors_are_far_apart(self) -> None:
        from skimage.color import rgb2lab

        lab = torch.from_numpy(rgb2lab(label_colors(12).numpy()))
        distances = torch.cdist(lab, lab) + 1000 * torch.eye(12)
        assert distances.min() > 15

    @pytest.mark.parametrize("n", [1.0, True, None])
    def test_type(self, n: Any) -> None:
        with pytest.raises(TypeError, match="n must be an integer"):
            label_colors(n)

    def test_negative(self) -> None:
        with pytest.raises(ValueError, match="n must be at least 0; got -1"):
            label_colors(-1)

    def test_colorize_any_ids(self) -> None:
        labels = torch.tensor([[0, 255, 10**12], [255, 255, 0]])
        image = colorize_labels(labels)
        assert image.shape == (3, 2, 3)
        assert torch.equal(image.permute(1, 2, 0)[0], label_colors(3))
        assert torch.equal(image[:, 1], label_colors(3)[[1, 1, 0]].T)

    def test_colorize_bad_labels(self) -> None:
        with pytest.raises(TypeError, match="labels must"):
            colorize_labels(torch.zeros(2, 2))
        with pytest.raises(ValueError, match="non-negative"):
            colorize_labels(torch.tensor([[-1]]))
