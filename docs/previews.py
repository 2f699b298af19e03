"""The first bytes of an image, of several codecs: `python docs/previews.py` makes the figure and prints the table."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from skimage import data as photos
from torch import Tensor
from torch.nn.functional import interpolate

from benchmarks.core.codecs import decode_file, largest_file
from kcgs.codec import CodecError, decode
from kcgs.functional import psnr
from kcgs.rate import fit_bytes
from kcgs.segment import segment

PATH = Path(__file__).resolve().parent / "images" / "previews.jpg"
BYTES = (300, 500, 1000)
WHOLE = 8_000
# sides of what the other codecs are given; they reach such sizes with small images only
FACTORS = (2, 3, 4, 6, 8, 12, 16, 24)
PREFIX, FILE = f"kcgs, the first of {WHOLE:,} bytes", "kcgs, a file of that size"
Preview = tuple[int, Tensor]  # bytes, and the image at its own size


def resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize (3, H, W) as browsers do, about: bicubic, and filtered where it shrinks."""
    return interpolate(image[None], size, mode="bicubic", antialias=True)[0].clamp(0, 1)


def other(codec: str, image: Tensor, max_bytes: int) -> Preview | None:
    """Shrink the image as far as gives the best preview of at most `max_bytes`; None: no size fits."""
    size, candidates = (image.shape[1], image.shape[2]), []
    for factor in FACTORS:
        small = resized(image, (max(1, round(size[0] / factor)), max(1, round(size[1] / factor))))
        coded = largest_file(codec, small, max_bytes)
        if len(coded) <= max_bytes:
            candidates.append((len(coded), resized(decode_file(coded), size)))
    return max(candidates, key=lambda preview: float(psnr(preview[1], image)), default=None)


def beginning(data: bytes, max_bytes: int) -> Preview | None:
    """Decode a file's first bytes; None: they hold no layer yet."""
    try:
        return max_bytes, decode(data[:max_bytes]).scene.render()
    except CodecError:
        return None


def thumbhash(image: Tensor) -> Preview:
    """Encode and decode an image as ThumbHash does (evanw.github.io/thumbhash): cosines of 4 bits."""
    size, longest = (image.shape[1], image.shape[2]), max(image.shape)
    small = resized(image, (round(100 * size[0] / longest), round(100 * size[1] / longest)))
    red, green, blue = small
    planes = {"l": (red + green + blue) / 3, "p": (red + green) / 2 - blue, "q": red - green}
    sides = tuple(max(3, round(7 * side / longest)) for side in (size[1], size[0]))
    decoded, numbers = {}, 0
    for name, plane in planes.items():
        across, down = sides if name == "l" else (3, 3)
        terms = [(x, y) for y in range(down) for x in range(across) if x * down < across * (down - y)]
        values = torch.stack([(plane * cosines(x, y, small.shape[1:])).mean() for x, y in terms])
        scale = values[1:].abs().max()
        # 6 bits for the mean, 5 or 6 for the scale
        steps = 31 if name == "l" else 63
        mean = (values[0] * 63).round() / 63 if name == "l" else ((values[0] + 1) * 31.5).round() / 31.5 - 1
        coefficients = ((0.5 + 0.5 / scale * values[1:]) * 15).round() / 7.5 - 1
        coefficients = coefficients * (scale * steps).round() / steps * (1 if name == "l" else 1.25)
        parts = (2 * value * cosines(x, y, size) for (x, y), value in zip(terms[1:], coefficients, strict=True))
        decoded[name] = sum(parts, mean.expand(size))
        numbers += len(coefficients)
    blue = decoded["l"] - 2 / 3 * decoded["p"]
    red = (3 * decoded["l"] - blue + decoded["q"]) / 2
    return 5 + math.ceil(numbers / 2), torch.stack([red, red - decoded["q"], blue]).clamp(0, 1)


def cosines(x: int, y: int, size: tuple[int, ...]) -> Tensor:
    """Evaluate the product of cosines of a frequency across and one down, (H, W)."""
    down, across = ((torch.arange(n) + 0.5) * math.pi / n for n in size)
    return torch.cos(y * down)[:, None] * torch.cos(x * across)


def previews(image: Tensor) -> dict[str, dict[int, Preview | None]]:
    """Make all previews of an image, by codec and bytes."""
    labels = segment(image)
    whole = fit_bytes(image, labels, WHOLE).data
    by_codec: dict[str, dict[int, Preview | None]] = {PREFIX: {}, FILE: {}, "WebP": {}, "AVIF": {}}
    for max_bytes in BYTES:
        file = fit_bytes(image, labels, max_bytes).data
        by_codec[PREFIX][max_bytes] = beginning(whole, max_bytes)
        by_codec[FILE][max_bytes] = len(file), decode(file).scene.render()
        for codec in ("WebP", "AVIF"):
            by_codec[codec][max_bytes] = other(codec, image, max_bytes)
    return by_codec


def show(image: Tensor, by_codec: dict[str, dict[int, Preview | None]]) -> None:
    """Write the figure of one image."""
    figure, axes = plt.subplots(len(BYTES) + 1, len(by_codec), figsize=(13, 9.2), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    hashed = thumbhash(image)
    for axis, (title, preview) in zip(axes[0], (("photo", None), ("ThumbHash", hashed)), strict=False):
        place(axis, title, image if preview is None else preview[1], None if preview is None else preview[0], image)
    for column, (codec, by_size) in enumerate(by_codec.items()):
        for row, max_bytes in enumerate(BYTES, 1):
            preview = by_size[max_bytes]
            if preview is None:
                axes[row, column].set_title(f"{codec}:\nnothing in {max_bytes} bytes", fontsize=9)
            else:
                place(axes[row, column], codec, preview[1], preview[0], image)
    figure.savefig(PATH, dpi=90, pil_kwargs={"quality": 85})
    plt.close(figure)


def place(axis: plt.Axes, title: str, shown: Tensor, size: int | None, image: Tensor) -> None:
    """Put an image in its place, with its size in bytes and its PSNR."""
    axis.imshow(shown.permute(1, 2, 0), interpolation="lanczos")
    facts = "" if size is None else f"\n{size} bytes, {float(psnr(shown, image)):.1f} dB"
    axis.set_title(title + facts, fontsize=9)


if __name__ == "__main__":
    for name in ("coffee", "astronaut", "chelsea"):
        image = torch.from_numpy(getattr(photos, name)() / 255).permute(2, 0, 1).float()
        by_codec = previews(image)
        if name == "coffee":
            show(image, by_codec)
        for codec, by_size in by_codec.items():
            figures = ["-" if p is None else f"{float(psnr(p[1], image)):.1f}" for p in by_size.values()]
            print(f"| {name} | {codec} | {' | '.join(figures)} |", flush=True)
        size, preview = thumbhash(image)
        print(f"| {name} | ThumbHash, {size} bytes | {float(psnr(preview, image)):.1f} | | |", flush=True)
