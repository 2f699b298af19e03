"""Layers of several energies, and files that end between them."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch

from kcgs import GaussianField, Scene
from kcgs.codec import CodecError, decode, encode
from kcgs.codec.file import pack, unpack

from .conftest import make_scene

GOLDEN = Path(__file__).parent / "golden.kcgs"


def test_no_layer_holds_few_gaussians() -> None:
    data = encode(make_scene(800, (96, 128)), quality=40)
    counts, ended = [], len(data) - sum(length + 2 for _, length in unpack(data)[0].layers)
    for _, length in unpack(data)[0].layers:
        ended += length + 2
        counts.append(decode(data[:ended]).scene.num_gaussians)
    layers = [end - start for start, end in itertools.pairwise([0, *counts])]
    assert len(layers) > 3
    assert sum(layers) == decode(data).scene.num_gaussians and min(layers) >= sum(layers) / 16


def test_energies_that_nothing_has() -> None:
    means = torch.rand(60, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([36, 24])
    strengths = torch.tensor([4e3, 3e2, *[0.5] * 58])
    alike = torch.tensor([[3.0, 0.5, 2.0]]).expand(60, -1)
    field = GaussianField(means, alike, strengths[:, None].expand(-1, 3), size=(24, 36))
    data = encode(Scene(field), quality=70)
    # the two strong ones are too few for a layer of their own
    assert len(unpack(data)[0].layers) == 1
    found = decode(data).scene.field
    assert torch.allclose(found.colors.amax(1).sort(descending=True).values, strengths, rtol=0.02)


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_every_cut_is_a_coarser_scene_or_refused(step: int) -> None:
    data, counts = GOLDEN.read_bytes(), set()
    for length in range(0, len(data), step):
        try:
            counts.add(decode(data[:length]).scene.num_gaussians)
        except CodecError:
            assert not counts
    assert len(counts) == decode(data).num_layers - 1


def test_golden_has_layers_of_one_energy() -> None:
    data = GOLDEN.read_bytes()
    energies = [energy for energy, _ in unpack(data)[0].layers]
    assert data[4] == 1 and energies == sorted(energies, reverse=True) and len(set(energies)) < len(energies)
    found = decode(data)
    assert (found.num_layers, found.scene.num_gaussians) == (5, 300)


def test_limits(scene: Scene) -> None:
    header, region_map, layers = unpack(encode(scene))
    many = header._replace(layers=(header.layers[0],) * 129)
    with pytest.raises(CodecError, match=r"layers must be in \[1, 128\]; got 129"):
        decode(pack(many, region_map, [layers[0]] * 129))
    for version in (0, 2, 3):
        with pytest.raises(CodecError, match=f"its version must be 1; got {version}"):
            decode(b"kcgs" + bytes([version]) + encode(scene)[5:])
