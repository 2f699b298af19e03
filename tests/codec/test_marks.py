"""Layers that end just before shares of the bytes, and layers of several energies."""

from __future__ import annotations

import itertools
import zlib
from pathlib import Path

import pytest
import torch

from kcgs import GaussianField, Scene
from kcgs.codec import CodecError, decode, encode
from kcgs.codec.file import pack, unpack
from kcgs.codec.gaussians.quantize import Quantizer
from kcgs.codec.scenes import SceneWriter

from .conftest import make_scene

MARKS = (0.25, 0.5, 0.75)
GOLDEN = Path(__file__).parent / "golden2.kcgs"


def write(scene: Scene, quality: float, marks: tuple[float, ...] = MARKS) -> bytes:
    writer = SceneWriter(scene)
    quantizer = Quantizer(writer.qp_for(quality), writer.size)
    codes = quantizer.quantize(writer.gaussians, quantizer.classify(writer.gaussians))
    return writer.write(quantizer, codes, writer.ids, marks=marks)


def ends(data: bytes) -> list[float]:
    """Return the shares of a file at which its layers end."""
    lengths = [length + 2 for _, length in unpack(data)[0].layers]
    return [1 - sum(lengths[i + 1 :]) / len(data) for i in range(len(lengths))]


def rows(scene: Scene) -> list[list[float]]:
    field = scene.field
    ids = torch.zeros(field.num_gaussians) if field.region_ids is None else field.region_ids
    return sorted(torch.cat([field.means, field.cholesky, field.colors, ids[:, None]], -1).detach().tolist())


@pytest.mark.parametrize(("regions", "seed"), [(1, 0), (3, 1), (2, 2)])
def test_layers_end_just_before_the_marks(regions: int, seed: int) -> None:
    scene = make_scene(2500, (96, 128), regions, seed=seed)
    data, whole = write(scene, 40.0), write(scene, 40.0, ())
    assert data[4] == whole[4] == 3 and len(whole) < len(data) < len(whole) + 60
    for mark in MARKS:
        assert mark - 0.06 < max(end for end in ends(data) if end <= mark)
    assert sorted(energy for energy, _ in unpack(data)[0].layers)[::-1] == [e for e, _ in unpack(data)[0].layers]


def test_the_same_gaussians(scene: Scene) -> None:
    for quality in (20.0, 50.0):
        parts, whole = decode(write(scene, quality)), decode(write(scene, quality, ()))
        assert parts.layers == parts.num_layers > whole.num_layers
        assert parts.scene.num_gaussians == whole.scene.num_gaussians
        # a centre is as fine as its cell allows, which depends on how many a layer holds
        torch.testing.assert_close(parts.scene.render(), whole.scene.render(), rtol=0, atol=0.05)


def test_a_mark_before_which_nothing_fits(scene: Scene) -> None:
    one = make_scene(1)
    assert write(one, 40.0) == write(one, 40.0, ())
    marked, whole = write(scene, 40.0, (0.001,)), write(scene, 40.0, ())
    energies = [energy for energy, _ in unpack(marked)[0].layers]
    assert len(set(energies)) == len(energies) > len(unpack(whole)[0].layers)
    assert rows(decode(marked).scene) == rows(decode(whole).scene)


def test_layers_of_several_energies() -> None:
    scene = make_scene(800, (96, 128))
    data = write(scene, 40.0, ())
    counts, ended = [], len(data) - sum(length + 2 for _, length in unpack(data)[0].layers)
    for _, length in unpack(data)[0].layers:
        ended += length + 2
        counts.append(decode(data[:ended]).scene.num_gaussians)
    assert len(counts) < len(unpack(write(scene, 40.0, (0.001,)))[0].layers)
    layers = [end - start for start, end in itertools.pairwise([0, *counts])]
    assert sum(layers) == decode(data).scene.num_gaussians and min(layers) >= sum(layers) / 16


def test_energies_that_nothing_has() -> None:
    means = torch.rand(60, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([36, 24])
    strengths = torch.tensor([4e3, 3e2, *[0.5] * 58])
    alike = torch.tensor([[3.0, 0.5, 2.0]]).expand(60, -1)
    field = GaussianField(means, alike, strengths[:, None].expand(-1, 3), size=(24, 36))
    data = write(Scene(field), 70.0, ())
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


def test_golden_is_decoded_as_ever() -> None:
    found = decode(GOLDEN.read_bytes())
    assert GOLDEN.read_bytes()[4] == 2 and (found.num_layers, found.scene.num_gaussians) == (13, 300)


def test_layers_of_one_energy_are_no_version_1() -> None:
    data = bytearray(write(make_scene(300, regions=1), 40.0))
    start = len(data) - sum(length + 2 for _, length in unpack(bytes(data))[0].layers) - 4
    data[4] = 1
    data[start : start + 4] = zlib.crc32(data[:start]).to_bytes(4, "big")
    with pytest.raises(CodecError, match=r"energy must be in \[1"):
        decode(bytes(data))


def test_limits(scene: Scene) -> None:
    header, region_map, layers = unpack(encode(scene))
    many = header._replace(layers=(header.layers[0],) * 129)
    with pytest.raises(CodecError, match=r"layers must be in \[1, 128\]; got 129"):
        decode(pack(many, region_map, [layers[0]] * 129))
    for version in (0, 4, 5):
        with pytest.raises(CodecError, match=f"its version must be 1, 2 or 3; got {version}"):
            decode(b"kcgs" + bytes([version]) + encode(scene)[5:])
