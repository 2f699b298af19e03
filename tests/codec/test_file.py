"""Damage: one clear error, or a coarser scene."""

from __future__ import annotations

import random

import pytest
import torch

from kcgs import RegionMap, Scene
from kcgs.codec import CodecError, Decoded, decode, encode
from kcgs.codec.file import ByteReader, pack, unpack

from .conftest import make_scene


def survives(data: bytes) -> bool:
    """Decode; say whether that was a scene, which must then be a sound one."""
    try:
        found = decode(data)
    except CodecError as error:
        assert str(error)
        return False
    assert_sound(found)
    return True


def assert_sound(found: Decoded) -> None:
    field, regions = found.scene.field, found.scene.regions
    for numbers in (field.means, field.cholesky, field.colors):
        assert torch.isfinite(numbers).all()
    assert (field.cholesky[:, ::2] > 0).all()
    if regions is not None:
        assert field.region_ids is not None and (regions.index_of(field.region_ids) >= 0).all()
        assert regions.size == field.size


def test_varints_have_five_bytes_at_most() -> None:
    assert ByteReader(bytes([129, 128, 128, 128, 0])).varint("width", 0, 1) == 1
    with pytest.raises(CodecError, match=r"width must be in \[0, 1\]; got a number of more than 35 bits"):
        ByteReader(bytes([129, 128, 128, 128, 128, 0])).varint("width", 0, 1)


def damaged(data: bytes, generator: random.Random) -> bytes:
    """Bits flipped, bytes lost, added, repeated, or cut at the end."""
    content = bytearray(data)
    kind = generator.randrange(5)
    at = generator.randrange(len(content))
    if kind == 0:
        for _ in range(generator.randint(1, 4)):
            content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
    elif kind == 1:
        del content[at : at + generator.randint(1, 9)]
    elif kind == 2:
        content[at:at] = generator.randbytes(generator.randint(1, 9))
    elif kind == 3:
        content[at : at + 8] = generator.randbytes(8)
    else:
        del content[at:]
    return bytes(content)


def hostile(data: bytes, generator: random.Random) -> bytes:
    """Damage with right checksums."""
    header, region_map, layers = unpack(data)
    layers = list(layers)
    kind = generator.randrange(4)
    if kind == 0:
        region_map = damaged(region_map, generator) or b"\0"
    elif kind == 1:
        at = generator.randrange(len(layers))
        layers[at] = damaged(layers[at], generator) or b"\0"
    elif kind == 2:
        sizes = [(1, 1), (7, 9), (300, 400), (1 << 20, 1), (1 << 20, 1 << 20)]
        header = header._replace(size=generator.choice(sizes))
    else:
        name, values = generator.choice(
            [("channels", [1, 2, 4, 900]), ("qp", [-512, 0, 1023]), ("regions", [1, 2, 4, 70000])]
        )
        header = header._replace(**{name: generator.choice(values)})
    header = header._replace(layers=tuple((e, len(x)) for (e, _), x in zip(header.layers, layers, strict=True)))
    return pack(header, region_map, layers)


def attack(count: int, seed: int) -> None:
    data = encode(make_scene())
    generator = random.Random(seed)
    whole = cut = 0
    for _ in range(count // 2):
        mutated = damaged(data, generator)
        cut += survives(mutated) and mutated != data
        whole += survives(hostile(data, generator))
    assert cut > 0 and whole > 0  # some are scenes still


class TestDamage:
    def test_a_hundred_and_fifty(self) -> None:
        attack(150, seed=0)

    @pytest.mark.slow
    def test_ten_thousand(self) -> None:
        attack(10_000, seed=1)

    def test_a_flipped_bit_is_found(self, scene: Scene) -> None:
        data = encode(scene)
        for at in range(0, len(data), 7):
            content = bytearray(data)
            content[at] ^= 16
            assert not survives(bytes(content))

    def test_every_cut_is_a_coarser_scene_or_refused(self, scene: Scene) -> None:
        data = encode(scene)
        counts = []
        for length in range(0, len(data), 3):
            try:
                found = decode(data[:length])
            except CodecError:
                assert not counts  # once there is a layer, longer ones have it too
                continue
            assert_sound(found)
            assert found.layers < found.num_layers
            counts.append(found.scene.num_gaussians)
        assert counts == sorted(counts) and counts[0] < counts[-1] < scene.num_gaussians

    @pytest.mark.parametrize("data", [b"", b"k", b"kcgs", b"kcgs\2", b"PNG0" * 9, bytes(100)])
    def test_no_file_at_all(self, data: bytes) -> None:
        with pytest.raises(CodecError):
            decode(data)

    def test_what_is_left_over_is_refused(self, scene: Scene) -> None:
        with pytest.raises(CodecError, match="must end after"):
            decode(encode(scene) + b"\0")

    def test_what_is_left_over_in_a_map_is_refused(self, scene: Scene) -> None:
        soft = RegionMap.from_labels(scene.regions.labels, 0.5)
        header, region_map, layers = unpack(encode(Scene(scene.field, soft)))
        with pytest.raises(CodecError, match="the map must end after"):
            decode(pack(header, region_map + b"\0", layers))
