"""Train the tables of label maps that follow, `kcgs/codec/labels/deviation.bin`, on sequences of label maps.

    python tests/codec/train_deviation.py FOLDER... -o deviation.bin [--steps 3000] [--seed 0]

A folder holds the maps of a sequence, of a foreground (not 0) and a background, in the order of their names. Each map
is predicted from the one before by an affine motion of the foreground, fitted to its contour; once exactly, and
once from settled maps to settled ones. Each pair is also mirrored and transposed. What is asked for are the examples.

The tables must not change, since clips depend on them. They were made of the first 24 frames of DAVIS' blackswan,
car-turn, dance-jump, dog, mallard-water and train by an earlier form of this script, whose settled maps were not
smoothed and whose random numbers came in another order: the same bytes cannot be made again.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from kcgs.codec.labels import move_labels, settle_labels, still_motions
from kcgs.codec.labels.deviation import AROUND, EARLIER, MARGIN, NETWORK, find_seeds, mark_band
from kcgs.codec.labels.moving import UNIT
from kcgs.data import load_labels

PER_MAP, BATCH = 2500, 2048
SCALES = (64, 64, 64, 4096, 64, 4096)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    generator = np.random.default_rng(options.seed)
    torch.manual_seed(options.seed)
    found = []
    for folder in options.folders:
        maps = [(load_labels(path).numpy() > 0).astype(np.int32) for path in sorted(folder.glob("*.png"))]
        for predicted, index in pairs(maps):
            for turn in (np.asarray, np.flipud, np.fliplr, np.transpose):
                features, deviates = examples(np.ascontiguousarray(turn(predicted)), np.ascontiguousarray(turn(index)))
                chosen = generator.permutation(len(deviates))[:PER_MAP]
                found.append((features[chosen], deviates[chosen]))
    features, deviates = (torch.from_numpy(np.concatenate(parts)) for parts in zip(*found, strict=True))
    options.output.write_bytes(pack(train(features, deviates, options.steps)))


def pairs(maps: list[Any]) -> list[tuple[Any, Any]]:
    """Predict each map from the one before; exact maps, then settled ones."""
    found = [(move_labels(last, estimate(last, index)), index) for last, index in pairwise(maps)]
    last = maps[0]
    for index in maps[1:]:
        predicted = move_labels(last, estimate(last, index))
        last = settle_labels(index, predicted, 2)
        found.append((predicted, last))
    return found


def estimate(last: Any, index: Any) -> Any:
    """Return the motions of two regions: none, or the affine one that brings the contours of region 1 together."""
    best = still_motions(2)
    if not last.any() or not index.any():
        return best
    inside = index == 1
    distance = ndimage.distance_transform_edt(last) - ndimage.distance_transform_edt(last == 0)
    slopes = np.gradient(ndimage.gaussian_filter(distance, 0.5))
    contour = inside ^ ndimage.binary_erosion(inside, border_value=1) | ndimage.binary_dilation(inside) ^ inside
    y, x = np.nonzero(contour)
    level, centre = np.where(inside[y, x], 0.5, -0.5), np.array(ndimage.center_of_mass(inside))[::-1]
    shift = np.array(ndimage.center_of_mass(last))[::-1] - centre
    for start in (np.zeros(2), shift):
        motion = np.array([[1, 0, start[0]], [0, 1, start[1]]])
        u = np.stack([(x + 0.5 - centre[0]) / 100, (y + 0.5 - centre[1]) / 100, np.ones(len(x))], 1)
        for step in range(32):
            place = motion @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))]) - 0.5
            off = ndimage.map_coordinates(distance, place[::-1], order=1, mode="nearest") - level
            slope = [ndimage.map_coordinates(s, place[::-1], order=1, mode="nearest")[:, None] for s in slopes[::-1]]
            columns = np.concatenate([s * (u if step >= 12 else u[:, 2:]) for s in slope], 1)
            weight = 1 / (1 + (off / (3.0 if step < 18 else 1.0)) ** 2)
            normal = columns.T @ (columns * weight[:, None]) + 1e-5 * len(off) * np.eye(columns.shape[1])
            move = -np.linalg.solve(normal, columns.T @ (weight * off)).reshape(2, -1)
            if step >= 12:
                motion[:, :2] += move[:, :2] / 100
                motion[:, 2] -= move[:, :2] @ centre / 100
            motion[:, 2] += move[:, -1]
            if step in (11, 31) and np.abs(motion).max() < 1000:
                moved = still_motions(2)
                moved[1] = np.rint(motion.reshape(6) * UNIT)
                best = min(best, moved, key=lambda m: int((move_labels(last, m) != index).sum()))
    return best


def examples(predicted: Any, index: Any) -> tuple[Any, Any]:
    """Return the features of each pixel that is asked for [N, F], and whether it deviates [N]."""
    asked, seeds = np.zeros(index.shape, np.uint8), np.zeros(index.shape, np.uint8)
    mark_band(predicted, asked)
    find_seeds(index, predicted, asked, seeds)
    y, x = np.nonzero(asked)
    first = predicted[y, x]
    labels, told = (np.pad(m, MARGIN, mode="edge") for m in (index, predicted))
    earlier = [(y + MARGIN + dy, x + MARGIN + dx) for dx, dy in EARLIER]
    around = [(y + MARGIN + dy, x + MARGIN + dx) for dx, dy in AROUND]
    features = [labels[place] != first for place in earlier] + [told[place] != first for place in around]
    features += [labels[place] != told[place] for place in earlier]
    return np.stack(features, 1), index[y, x] != first


def train(features: Tensor, deviates: Tensor, steps: int) -> list[Tensor]:
    """Return the weights and biases of the three layers, by Adam with the rounding of the format."""
    sizes = [features.shape[1], NETWORK[1][1][0], NETWORK[3][1][0], 1]
    parameters = [t for a, b in pairwise(sizes) for t in (torch.randn(a, b) * a**-0.5, torch.zeros(b))]
    for parameter in parameters:
        parameter.requires_grad_()
    optimizer = torch.optim.Adam(parameters, lr=4e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 8e-3, total_steps=steps)
    for _ in range(steps):
        batch = torch.randint(len(features), (BATCH,))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(
            network(features[batch].float(), parameters), deviates[batch].float()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return parameters


def whole(values: Tensor, scale: int, kind: str) -> Tensor:
    most = 127 if kind == "<i1" else 32767 if kind == "<i2" else 1 << 30
    return (values * scale).round().clamp(-most, most)


def network(x: Tensor, parameters: list[Tensor]) -> Tensor:
    """Evaluate the network with rounded weights, whose gradients pass the rounding."""
    kinds = zip(parameters, SCALES, NETWORK, strict=True)
    values = [t + (whole(t, scale, kind) / scale - t).detach() for t, scale, (kind, _) in kinds]
    for weight, bias in zip(values[:-2:2], values[1:-2:2], strict=True):
        x = (x @ weight + bias).clamp(0, 4095 / 64)
    return (x @ values[-2] + values[-1]).clamp(-12, 12)[:, 0]


def pack(parameters: list[Tensor]) -> bytes:
    """Write the tables as the format has them."""
    kinds = zip(parameters, SCALES, NETWORK, strict=True)
    return b"".join(whole(t.detach(), scale, kind).numpy().astype(kind).tobytes() for t, scale, (kind, _) in kinds)


if __name__ == "__main__":
    main()
