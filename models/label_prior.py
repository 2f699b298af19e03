"""Train the tables of the label model, `kcgs/codec/labels/scene_prior.bin` and `map_file_prior.bin`, on label maps.

    python -m models.label_prior MAP... -o FILE [--photos PHOTO...] [--units 48 16] [--steps 8000] [--seed 0]

Maps are files that `kcgs.data.load_labels` reads. Of each of the photos, and of scikit-image's, segmentations are made,
of the whole size and of half, and smoothed ones. Synthetic shapes are added. Each map is coded, also mirrored and
turned. Its coded pixels are the examples: the features of a pixel, and which candidate it has. A network with the
format's rounding is trained on them by Adam and written as integers.

The tables must not change, since all files depend on them. Those of files of maps, `map_file_prior.bin`, were made by

    python -m models.label_prior -o map_file_prior.bin --units 96 32 --steps 16000 --photos KODAK/kodim*.png

of 14 Kodak photos (02 03 06 07 09 11 12 15 16 18 19 22 23 24). Those of scenes were trained on segmentations of Kodak
photos and of scikit-image's, and on shapes. The list of those maps is lost, so their exact bytes cannot be made again.
The starting weights of the mixer were found by trying and are kept.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from benchmarks.core.images import load
from kcgs.codec.labels.contexts import TEMPLATE, layout
from kcgs.codec.labels.wavefront import advance, new_scan, order_regions
from kcgs.data import load_image, load_labels
from kcgs.segment import segment

MIXER = (46000, 7000, 7000, 8000)
SHAPES = 60  # synthetic maps
BATCH = 2048  # pixels of a step
PER_MAP = 2000  # pixels, at most
PHOTOS = ("astronaut", "chelsea", "coffee", "rocket")
METHODS = ("auto", "kmeans", "felzenszwalb", "slic", "watershed")
SMOOTH = (0.7, 1.0, 1.5, 2.0, 3.0)
UNIT = 64  # weights and activations are whole 1 / UNIT


def main(arguments: list[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, metavar="MAP")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--photos", nargs="*", type=Path, default=[], metavar="PHOTO")
    parser.add_argument("--units", nargs=2, type=int, default=(48, 16))
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    maps = [load_labels(path).numpy() for path in options.maps]
    if options.photos:
        photos = [load_image(path) for path in options.photos]
        maps += segmentations([*photos, *(load(name).image for name in PHOTOS)], options.seed)
    options.output.write_bytes(pack(train(maps, options.steps, options.seed, tuple(options.units))))


def examples(labels: Any) -> tuple[Any, Any]:
    """Code a map; return the features of each coded pixel [N, T], and its class [N].

    The class is 0 or 1 for the first or the second candidate, 2 for neither.
    """
    ids, index = np.unique(labels, return_inverse=True)
    truth, seeds, _ = order_regions(index.reshape(labels.shape).astype(np.int32), len(ids))
    scan = new_scan(seeds, len(ids), is_file=False)
    features, classes = [np.zeros((0, len(TEMPLATE)), np.int8)], [np.zeros(0, np.int64)]
    while count := advance(scan, scan.answers, truth):
        pixels = scan.pixels[:count]
        pixels = pixels[pixels["is_coded"] == 1]
        features.append(pixels["features"].astype(np.int8))
        label = pixels["label"]
        classes.append(np.where(label == pixels["first"], 0, np.where(label == pixels["second"], 1, 2)))
    return np.concatenate(features), np.concatenate(classes)


def segmentations(photos: list[Tensor], seed: int) -> list[Any]:
    """Segment photos in all ways that need no model, in two sizes; every other map is smoothed, by so many pixels."""
    generator, maps = np.random.default_rng(seed), []
    for number, whole in enumerate(photos):
        for image in (whole, torch.nn.functional.avg_pool2d(whole, 2)):
            for method in METHODS:
                labels = segment(image, method).numpy()
                maps += [labels, smoothed(labels, generator.choice(SMOOTH))]
        print(f"photo {number}: {len(maps)} maps", file=sys.stderr)
    return maps


def smoothed(labels: Any, sigma: float) -> Any:
    """Give each pixel the region that has most of its surroundings."""
    ids, index = np.unique(labels, return_inverse=True)
    index = index.reshape(labels.shape)
    shares = (gaussian_filter((index == region).astype(np.float32), sigma) for region in range(len(ids)))
    largest, regions = np.full(labels.shape, -1.0, np.float32), np.zeros(labels.shape, np.int64)
    for region, share in enumerate(shares):
        regions[share > largest] = region
        largest = np.maximum(largest, share)
    return regions


def shapes(generator: np.random.Generator) -> Any:
    """Make a map of overlapping ellipses and half planes."""
    height, width = generator.integers(100, 400, 2)
    y, x = np.mgrid[:height, :width]
    labels = np.zeros((height, width), np.int64)
    for region in range(1, generator.integers(2, 12)):
        angle, (cy, cx) = generator.uniform(0, np.pi), generator.uniform(0, 1, 2) * (height, width)
        along = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        across = (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
        if generator.random() < 0.2:
            labels[along > 0.4 * width] = region
        else:
            labels[(along / generator.uniform(5, 90)) ** 2 + (across / generator.uniform(5, 90)) ** 2 < 1] = region
    return labels


def train(maps: list[Any], steps: int, seed: int, units: tuple[int, int] = (48, 16)) -> list[Tensor]:
    """Return the weights and biases of the three layers, in whole units."""
    generator = np.random.default_rng(seed)
    torch.manual_seed(seed)
    samples = []
    for labels in [*maps, *(shapes(generator) for _ in range(SHAPES))]:
        for turned in (labels, labels[::-1], labels[:, ::-1], labels.T):
            features, classes = examples(np.ascontiguousarray(turned))
            index = generator.permutation(len(classes))[:PER_MAP]
            has_neither = np.full(len(index), len(np.unique(labels)) > 2)
            samples.append((features[index], classes[index], has_neither))
    features, classes, has_neither = (torch.from_numpy(np.concatenate(parts)) for parts in zip(*samples, strict=True))
    print(f"{len(classes)} examples", file=sys.stderr)
    sizes = [2 * len(TEMPLATE), *units, 2]
    parameters = [torch.randn(a, b) * a**-0.5 for a, b in pairwise(sizes)]
    parameters = [t.requires_grad_() for w in parameters for t in (w, torch.zeros(w.shape[1]))]
    optimizer = torch.optim.Adam(parameters, lr=4e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps)
    for step in range(steps):
        batch = torch.randint(len(classes), (BATCH,))
        target = classes[batch]
        logits = network(features[batch], parameters)
        losses = torch.nn.functional.binary_cross_entropy_with_logits(
            logits, torch.stack([(target == 1).float(), (target == 2).float()], 1), reduction="none"
        )
        loss = (losses[:, 0] * (target < 2) + losses[:, 1] * has_neither[batch]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 1000 == 0 or step == steps - 1:
            print(f"step {step}: {float(loss.detach()) / np.log(2):.4f} bits per pixel", file=sys.stderr)
    return [rounded(t.detach(), scale, most) for t, (scale, most) in zip(parameters, limits(), strict=True)]


def limits() -> list[tuple[int, int]]:
    """Return the unit of each tensor, and the most that its type holds."""
    return [(UNIT, 127), (UNIT, 32767), (UNIT, 127), (UNIT**2, 1 << 30), (UNIT, 127), (UNIT**2, 1 << 30)]


def rounded(values: Tensor, scale: int, most: int) -> Tensor:
    """Round to whole units."""
    return (values * scale).round().clamp(-most, most) / scale


def network(features: Tensor, parameters: list[Tensor]) -> Tensor:
    """Evaluate the network with rounded weights, whose gradients pass the rounding."""
    pairs = zip(parameters, limits(), strict=True)
    values = [t + (rounded(t, scale, most) - t).detach() for t, (scale, most) in pairs]
    x = torch.stack([features == 1, features == 2], -1).flatten(1).float()
    for weight, bias in zip(values[:-2:2], values[1:-2:2], strict=True):
        x = (x @ weight + bias).clamp(0, 4095 / UNIT)
    return (x @ values[-2] + values[-1]).clamp(-12, 12)


def pack(parameters: list[Tensor]) -> bytes:
    """Write the tables as the format has them."""
    whole = [(t * scale).round().long().numpy() for t, (scale, _) in zip(parameters, limits(), strict=True)]
    tables = [whole[0].reshape(len(TEMPLATE), 2, -1), *whole[1:], np.array(MIXER)]
    return b"".join(
        table.astype(kind).tobytes() for table, (kind, _) in zip(tables, layout(*whole[2].shape), strict=True)
    )


if __name__ == "__main__":
    main()
