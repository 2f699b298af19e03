"""Tiles against the definition of membership: regions of tiles, and weights of their pixels."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from kcgs import RegionMap
from kcgs.maps import MapTable, Membership
from kcgs.maps.device_tiles import tiles_on_device
from kcgs.maps.widths import ContourWidths, blurs_of, find_widths, search_widths

TILE = 16
Widths = float | dict[tuple[int, int], float]
Tiles = tuple[Tensor, Tensor, Tensor, Tensor]


def random_labels(*shape: int, regions: int, grain: int = 1, seed: int = 0) -> Tensor:
    """Blocks of `grain` pixels with random labels, of which all occur if there is room."""
    generator = torch.Generator().manual_seed(seed)
    maps, *sides = shape
    blocks = [-(-side // grain) for side in sides]
    labels = torch.randperm(maps * math.prod(blocks), generator=generator).view(maps, *blocks) % regions
    return labels.repeat_interleave(grain, 1).repeat_interleave(grain, 2)[:, : sides[0], : sides[1]]


def cake(slices: int, size: int = 40) -> Tensor:
    """Regions that all meet in one pixel."""
    y, x = torch.meshgrid(torch.arange(size) - 24.5, torch.arange(size) - 23.5, indexing="ij")
    return ((torch.atan2(y, x) / (2 * math.pi) + 0.5) * slices).long().clamp_max(slices - 1)[None]


def pairs(regions: int, widths: list[float]) -> dict[tuple[int, int], float]:
    return dict(zip(itertools.combinations(range(regions), 2), itertools.cycle(widths), strict=False))


MAPS: dict[str, Tensor] = {
    "one row": torch.arange(50).view(1, 1, 50) // 7,
    "one region": torch.zeros(2, 20, 40).long(),
    "eight in a tile": cake(8),
    "batch": random_labels(2, 35, 50, regions=4, grain=9),
    "pixels": random_labels(1, 20, 33, regions=300),
}


def membership_of(labels: Tensor, softness: Widths) -> Membership:
    index, count = labels.int(), int(labels.max()) + 1
    widths, width_index = find_widths(index, count, softness)
    ids, blurs = torch.arange(count, device=labels.device), blurs_of(widths, labels.device)
    return Membership(MapTable(labels, blurs, width_index, ids, index))


@pytest.fixture(params=["torch", "compiled"])
def tiles_of(request: pytest.FixtureRequest) -> Callable[[Membership], Tiles]:
    """The tiles as any device makes them, and as the CPU does."""
    if request.param == "compiled":
        return lambda membership: membership.tiled_table.tiles
    return lambda membership: tiles_on_device(
        membership.index, membership.table.num_regions, membership.widths, membership.table.width_index
    )


def tile_slices(shape: torch.Size) -> list[tuple[int, slice, slice]]:
    maps, height, width = shape
    corners = itertools.product(range(maps), range(0, height, TILE), range(0, width, TILE))
    return [(b, slice(y, min(y + TILE, height)), slice(x, min(x + TILE, width))) for b, y, x in corners]


def check(result: Tiles, membership: Membership, contours: ContourWidths | None = None) -> None:
    """Compare with regions that are looked for pixel by pixel, and with dense weights."""
    index, count = membership.index, membership.table.num_regions
    widths, width_index = contours or (membership.widths, membership.table.width_index)
    oracle = [torch.stack([membership.weights(b, r, torch.float64) for r in range(count)]) for b in range(len(index))]
    tiles = tile_slices(index.shape)
    assert [part.dtype for part in result] == [torch.int32] * 3 + [torch.float32]
    starts, regions_of_tiles, planes, weights = result[0].tolist(), result[1], result[2].tolist(), result[3]
    assert starts[0] == 0 and len(starts) == len(tiles) + 1 and starts[-1] == len(regions_of_tiles)
    assert [plane for plane in planes if plane >= 0] == list(range(len(weights)))
    for (b, rows, cols), first, end in zip(tiles, starts[:-1], starts[1:], strict=True):
        reach = math.ceil(4 * widths[0 if width_index is None else int(width_index[b, rows, cols].max())])
        around = [slice(max(s.start - reach, 0), s.start + TILE + reach) for s in (rows, cols)]
        regions = index[b, around[0], around[1]].unique()
        assert torch.equal(regions_of_tiles[first:end].long(), regions.long())
        is_alone = len(regions) == 1
        assert all((plane < 0) == is_alone for plane in planes[first:end])
        expected = torch.zeros(count, TILE, TILE)
        expected[regions.long()] = 1.0 if is_alone else weights[planes[first:end]].view(-1, TILE, TILE)
        dense = oracle[b][:, rows, cols]
        assert (expected[:, : dense.shape[1], : dense.shape[2]] - dense).abs().max() < 1e-6


@pytest.mark.parametrize(("name", "softness"), [*((name, 0.7) for name in MAPS), ("batch", 0.0), ("one row", 3.0)])
def test_one_width(name: str, softness: float, tiles_of: Callable[[Membership], Tiles]) -> None:
    membership = membership_of(MAPS[name], softness)
    check(tiles_of(membership), membership)


@pytest.mark.parametrize("name", ["eight in a tile", "batch"])
def test_widths_of_pairs(name: str, tiles_of: Callable[[Membership], Tiles]) -> None:
    softness = pairs(int(MAPS[name].max()) + 1, [0.7, 0.0, 2.2, 1.1])
    membership = membership_of(MAPS[name], softness)
    assert membership.table.width_index is not None
    check(tiles_of(membership), membership)


@pytest.mark.parametrize("softness", [64.0, pairs(5, [64.0, 0.5, 20.0])])
def test_wide_contours(
    softness: Widths, tiles_of: Callable[[Membership], Tiles], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kcgs.maps.device_tiles._CHUNK_BYTES", 1 << 24)  # of many parts
    membership = membership_of(random_labels(1, 50, 70, regions=5, grain=17), softness)
    check(tiles_of(membership), membership)


@pytest.mark.parametrize(
    ("shape", "values"),
    [((1, 1, 60), [0.3, 0.9, 0.0, 1.4]), ((2, 40, 35), [0.3, 0.9, 0.0, 1.4]), ((1, 90, 3), [0.5, 12.0])],
)
def test_widths_of_pixels(shape: tuple[int, int, int], values: list[float]) -> None:
    """They are those of the nearest contours, ties included; beyond the reach of contours they do not matter."""
    labels = random_labels(*shape, regions=6, grain=7)
    membership = membership_of(labels, pairs(6, values))
    contours = search_widths(membership.index, 6, pairs(6, values))
    check(tiles_on_device(membership.index, 6, *contours), membership, contours)
    widths, level = membership.widths, membership.table.width_index
    pixels, expected = (
        torch.full(shape, w[0]) if i is None else torch.tensor(w)[i.long()] for w, i in (contours, (widths, level))
    )
    is_far = torch.ones(shape).bool()
    reach = math.ceil(4 * max(values))
    for b, (y, x) in itertools.product(range(shape[0]), itertools.product(*map(range, shape[1:]))):
        around = labels[b, max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        is_far[b, y, x] = bool((around == labels[b, y, x]).all())
    assert torch.equal(pixels[~is_far], expected[~is_far])


@pytest.mark.parametrize("softness", [0.7, pairs(4, [0.5, 0.0, 2.0])])
def test_devices_agree(softness: Widths, device: torch.device) -> None:
    membership, moved = (membership_of(MAPS["batch"].to(d), softness) for d in ("cpu", device))
    tiles, pixels = moved.tiled_table.tiles, moved.table.width_index
    contours = ContourWidths(moved.widths, None if pixels is None else pixels.cpu())
    check(tuple(part.cpu() for part in tiles), membership, contours)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("softness", [0.7, pairs(4, [0.5, 0.0, 2.0])])
def test_waits_for_the_device(softness: Widths) -> None:
    labels = MAPS["batch"].cuda()
    with warnings.catch_warnings(record=True) as waits:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            RegionMap(labels, softness)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    count = len([wait for wait in waits if "synchroniz" in str(wait.message)])
    assert count <= (4 if isinstance(softness, float) else 6)
