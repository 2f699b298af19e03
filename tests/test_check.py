"""Checks that public functions share."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from PIL import Image

from kcgs import InvalidArgument, InvalidArgumentType
from kcgs._check import check_count, check_floating, check_labels, check_number, check_numbers
from kcgs._image import as_image


class TestErrors:
    @pytest.mark.parametrize("kind", [InvalidArgument, InvalidArgumentType])
    def test_survive_pickling_and_copies(self, kind: type[InvalidArgument] | type[InvalidArgumentType]) -> None:
        error = kind("means", "shape (..., 2)", (2, 3), verb="have")
        for twin in (error, pickle.loads(pickle.dumps(error)), copy.copy(error), copy.deepcopy(error)):
            assert type(twin) is kind and str(twin) == "means must have shape (..., 2); got (2, 3)"
            assert (twin.name, twin.expected, twin.received) == ("means", "shape (..., 2)", (2, 3))

    def test_of_checks_are_built_in_errors_with_a_name(self) -> None:
        with pytest.raises(ValueError, match="count must be at least 1; got 0") as caught:
            check_count("count", 0)
        assert isinstance(caught.value, InvalidArgument) and caught.value.received == 0
        with pytest.raises(TypeError, match="means must have a real floating dtype; got torch.int64") as wrong:
            check_floating("means", torch.zeros(2, dtype=torch.int64))
        assert isinstance(wrong.value, InvalidArgumentType) and wrong.value.name == "means"


class TestCheckCount:
    @pytest.mark.parametrize("value", [True, 2.0, "2", None])
    def test_refuses_what_is_no_integer(self, value: object) -> None:
        with pytest.raises(TypeError, match="steps must be an integer; got "):
            check_count("steps", value)

    def test_range(self) -> None:
        assert check_count("steps", np.int64(3)) == 3
        with pytest.raises(ValueError, match="steps must be at least 1; got 0"):
            check_count("steps", 0)
        with pytest.raises(ValueError, match=r"steps must be in \[2, 16\]; got 17"):
            check_count("steps", 17, 2, 16)


class TestCheckNumber:
    def test_range(self) -> None:
        assert check_number("sigma", np.float32(0.5), 0, 8) == 0.5
        with pytest.raises(ValueError, match=r"sigma must be in \(0, 8\] pixels; got 0.0"):
            check_number("sigma", 0.0, 0, 8, unit="pixels", above=True)
        with pytest.raises(ValueError, match="cost must be finite and at least 0; got nan"):
            check_number("cost", float("nan"), 0)
        with pytest.raises(TypeError, match="sigma must be a number of pixels; got True"):
            check_number("sigma", True, unit="pixels")


class TestCheckNumbers:
    def test_count_type_and_range(self) -> None:
        assert check_numbers("mean", (0, 0.5, 1), 3, 0, 1) == (0.0, 0.5, 1.0)
        for wrong in ("abc", 0.5, None):
            with pytest.raises(TypeError, match="mean must be 3 numbers; got"):
                check_numbers("mean", wrong, 3)
        with pytest.raises(ValueError, match="mean must be 3 numbers; got"):
            check_numbers("mean", [0.5], 3)
        with pytest.raises(ValueError, match="mean must be finite and above 0; got 0"):
            check_numbers("mean", [1, 0, 1], 3, 0, above=True)


class TestCheckLabels:
    def test_masks_and_arrays_are_maps(self) -> None:
        want = torch.tensor([[0, 1, 1], [0, 0, 1]])
        array = np.ascontiguousarray(want.numpy()[:, ::-1])[:, ::-1]  # of negative strides
        for given in (want.bool(), array, array.astype(bool), array.astype(np.uint16), array.astype(">i2")):
            labels = check_labels("labels", given)
            assert torch.equal(labels, want) and labels.dtype == torch.int64
        with pytest.raises(TypeError, match="labels must have an integer dtype; got float32"):
            check_labels("labels", array.astype(np.float32))


class TestAsImage:
    def test_all_kinds_are_one_image(self) -> None:
        levels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
        expected = torch.from_numpy(levels).permute(2, 0, 1).float() / 255
        for image in (expected, expected[None], levels, levels.astype(np.float32) / 255, Image.fromarray(levels)):
            assert torch.equal(as_image("image", image), expected)

    def test_grey_deep_and_palette(self) -> None:
        grey = np.arange(35, dtype=np.uint8).reshape(5, 7)
        assert as_image("image", grey).shape == as_image("image", Image.fromarray(grey)).shape == (1, 5, 7)
        assert float(as_image("image", np.full((5, 7), 65535, np.uint16)).min()) == 1.0
        palette = Image.fromarray(grey).convert("P")
        assert torch.equal(as_image("image", palette)[:1], as_image("image", grey))

    def test_transparent_pixels_are_composed_on_white(self) -> None:
        image = Image.new("RGBA", (4, 3), (0, 0, 0, 0))
        assert bool((as_image("image", image) == 1.0).all())

    def test_tolerance(self) -> None:
        image = torch.tensor([[[0.0, 1.0005]]])
        assert torch.equal(as_image("image", image, tolerance=1e-3), image)

    def test_refuses(self) -> None:
        with pytest.raises(ValueError, match=r"image must be in \[0, 1\]; got \[0, 2\]"):
            as_image("image", torch.tensor([[[0.0, 2.0]]]))
        with pytest.raises(TypeError, match="uint8, uint16, float32 or float64; got int64"):
            as_image("image", np.zeros((3, 4, 3), np.int64))
        with pytest.raises(ValueError, match="1 to 4 channels"):
            as_image("image", np.zeros((3, 4, 5), np.float32))
        with pytest.raises(ValueError, match="must be one image"):
            as_image("image", torch.zeros(2, 3, 4, 4))
        for shape in ((80, 120, 3), (1, 80, 120, 3), (80, 120, 1)):
            with pytest.raises(ValueError, match=r"looks like \(H, W, C\): pass image.permute\(2, 0, 1\)"):
                as_image("image", torch.zeros(shape))
        for shape in ((3, 120, 3), (80, 3, 3), (80, 120, 2), (80, 1, 1)):  # thin images, and many channels
            assert as_image("image", torch.zeros(shape)).shape == shape
        with pytest.raises(TypeError, match="or a PIL image; got str: read it with kcgs.data.load_image"):
            as_image("image", "photo.jpg")
