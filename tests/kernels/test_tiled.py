"""The kernel `tiled` beyond what every backend is tested for: pieces and chunks, large maps, threads."""

from __future__ import annotations

import pytest
import torch

from kcgs import RegionMap
from kcgs.kernels import tiled

from ..functional.test_splat import as_float32, gradients, random_scene


def test_pieces_and_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(50, (47, 61), 5)
    region_map = RegionMap(scene.labels, 0.7)
    # memberships are float32
    image, grads = gradients(scene, region_map, cutoff=0, backend="reference")
    monkeypatch.setattr(tiled, "_PIECE", 3)
    monkeypatch.setattr(tiled, "_CHUNK", 5)
    got, got_grads = gradients(scene, region_map, cutoff=0, backend="tiled")
    for a, b in zip([got, *got_grads], [image, *grads], strict=True):
        assert (a - b).abs().max() < 1e-7 * b.abs().max()


def test_keys_beyond_32_bits() -> None:
    """A large map has many tiles and many regions, and its arrays are int32."""
    starts, regions = torch.arange(70_001, dtype=torch.int32), torch.full((70_000,), 69_999, dtype=torch.int32)
    assert int(tiled.keys_of(starts, regions, 70_000)[-1]) == 70_000**2 - 1


def test_same_bits_on_several_threads() -> None:
    scene = random_scene(5000, (16, 20), 2)  # many pieces of one tile
    region_map = RegionMap(scene.labels, 0.7)
    threads = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        results = [gradients(as_float32(scene), region_map, backend="tiled") for _ in range(3)]
    finally:
        torch.set_num_threads(threads)
    for image, grads in results[1:]:
        assert torch.equal(image, results[0][0]) and all(map(torch.equal, grads, results[0][1]))
