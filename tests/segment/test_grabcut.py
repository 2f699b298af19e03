"""One object from a box and clicks, by GrabCut."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs.segment import segment, segment_with_scores

pytest.importorskip("cv2", reason="needs the extra: pip install opencv-python-headless")

BOX = (20, 12, 74, 52)


def scene(scale: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Return an image with a red disc and a blue one beside it, on noisy green, and where the discs are."""
    y, x = (torch.arange(n * scale) / scale for n in (64, 96))
    red, blue = ((y[:, None] - 32) ** 2 + (x - center) ** 2 < 15**2 for center in (36, 60))
    image = torch.tensor([0.2, 0.6, 0.2])[:, None, None].expand(3, 64 * scale, 96 * scale).clone()
    image[:, blue] = torch.tensor([0.1, 0.2, 0.8])[:, None]
    image[:, red] = torch.tensor([0.9, 0.1, 0.1])[:, None]
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    return (image + 0.03 * noise).clamp(0, 1), red, blue & ~red


def cut(image: Tensor, box: Any = BOX, **clicks: Any) -> Tensor:
    labels, scores, names = segment_with_scores(image, "grabcut", box=box, **clicks)
    assert scores is None and names is not None and set(names.values()) <= {"object", "background"}
    return torch.isin(labels, torch.tensor([region for region, name in names.items() if name == "object"]))


def overlap(mask: Tensor, other: Tensor) -> float:
    return float((mask & other).sum() / (mask | other).sum())


def test_a_box_has_all_that_is_not_background() -> None:
    image, red, blue = scene()
    assert overlap(cut(image), red | blue) > 0.97
    assert torch.equal(segment(image, "grabcut", box=torch.tensor(BOX)), segment(image, "grabcut", box=BOX))
    points = np.argwhere(red.numpy())[::200, ::-1]  # (x, y), with a negative stride
    masks = (segment(image, "grabcut", box=BOX, foreground=clicks) for clicks in (points, list(points)))
    assert torch.equal(*masks)


def test_a_click_removes_a_part() -> None:
    image, red, _ = scene()
    assert overlap(cut(image, background=torch.tensor([[66.0, 32.0]])), red) > 0.95


def test_a_click_adds_a_part() -> None:
    image, red, blue = scene()
    image[:, blue] += torch.tensor([0.1, 0.4, -0.6])[:, None]  # like the background
    before, after = cut(image), cut(image, foreground=[[66, 32]])
    assert not before[32, 66] and after[32, 66] and overlap(after, red | blue) > overlap(before, red | blue)


def test_large_images_are_cut_at_a_smaller_size() -> None:
    image, red, blue = scene(scale=6)
    assert overlap(cut(image, tuple(6 * edge for edge in BOX)), red | blue) > 0.97


@pytest.mark.parametrize("size", [(1, 5), (2, 2)])
def test_small_images(size: tuple[int, int]) -> None:
    image = torch.rand(3, *size, generator=torch.Generator().manual_seed(0))
    assert cut(image, (0, 0, 1, 0.5), foreground=[[0, 0]], background=[[size[1], size[0]]]).shape == size


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "box must be given for the method 'grabcut'; got none"),
        ({"box": (0, 0, 96, 64)}, "box must have pixels of the background around it; got a box of the whole image"),
        ({"box": (50, 0, 40, 9)}, r"box must hold left, top, right, bottom with pixels of the 96 x 64 image; got \(50"),
        ({"box": (1, 2, 3)}, "box must be 4 numbers"),
        ({"box": BOX, "foreground": [[3, 4]]}, r"foreground must be in the box; got \(3.0, 4.0\)"),
        ({"box": BOX, "foreground": [3, 4]}, r"foreground must be a list of points \(x, y\); got \[3, 4\]"),
        ({"box": BOX, "background": [[97, 4]]}, r"background must be in \[0, 96\]; got 97"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        segment(scene()[0], "grabcut", **options)


def test_no_object_is_found() -> None:
    with pytest.raises(ValueError, match="no object is found: give a box around it, or a point of it"):
        segment(torch.full((3, 64, 96), 0.5), "grabcut", box=BOX, background=[(30, 30), (50, 20), (40, 40), (65, 30)])


def test_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"pip install opencv-python-headless"):
        cut(scene()[0])


def test_a_click_that_the_mask_does_not_follow() -> None:
    image, *_ = scene()
    with pytest.warns(UserWarning, match="the click at 25, 16 is not in the background"):
        cut(image, foreground=[[24, 16]], background=[[25, 16]])
