"""The kernel `tiled` beyond what every backend is tested for: float64, pieces and chunks, nothing to render."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs import RegionMap
from kcgs.kernels import tiled

from ..functional.test_splat import as_float32, gradients, random_scene


def differences(got: tuple[Tensor, list[Tensor]], want: tuple[Tensor, list[Tensor]]) -> list[float]:
    """Return the largest differences of image and gradients, relative to the largest values."""
    pairs = zip([got[0], *got[1]], [want[0], *want[1]], strict=True)
    return [float((a - b).abs().max() / b.abs().max()) for a, b in pairs]


@pytest.mark.parametrize("softness", [0.0, 0.7])
@pytest.mark.parametrize(("count", "size", "regions"), [(5, (1, 1), 1), (400, (47, 61), 5)])
def test_float64(count: int, size: tuple[int, int], regions: int, softness: float) -> None:
    scene = random_scene(count, size, regions)
    region_map = RegionMap(scene.labels, softness)
    got, want = (gradients(scene, region_map, cutoff=0, backend=name) for name in ("tiled", "reference"))
    # memberships are float32
    assert max(differences(got, want)) < (1e-7 if softness else 1e-12)


@pytest.mark.parametrize(("piece", "chunk"), [(1, 1), (3, 5)])
def test_pieces_and_chunks_change_nothing(piece: int, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(50, (47, 61), 5)
    region_map = RegionMap(scene.labels, 0.7)
    want = gradients(scene, region_map, backend="tiled")
    monkeypatch.setattr(tiled, "_PIECE", piece)
    monkeypatch.setattr(tiled, "_CHUNK", chunk)
    assert max(differences(gradients(scene, region_map, backend="tiled"), want)) < 1e-12


@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("regions", [1, 2])
def test_nothing_to_render(count: int, regions: int) -> None:
    scene = random_scene(count, (20, 30), regions)
    scene = scene._replace(means=scene.means + 1e6)
    image, grads = gradients(scene, RegionMap(scene.labels), backend="tiled")
    assert torch.equal(image, torch.zeros_like(image))
    assert all(torch.equal(gradient, torch.zeros_like(t)) for gradient, t in zip(grads, scene[:3], strict=True))


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
