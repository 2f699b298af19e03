"""The web's decoder of clips against Python's: the same bits of every frame, or an error."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene
from kcgs.codec import CodecError, encode
from kcgs.codec.clips.carried import Change, ClipPart, born_codes
from kcgs.codec.clips.differences import Differences
from kcgs.codec.clips.file import ClipHeader, Record, pack_end, pack_header, pack_record, unpack
from kcgs.codec.clips.frames import FrameReader, carried_record, key_record
from kcgs.codec.gaussians.quantize import Parameters, Quantizer
from kcgs.functional.labels import touching_pairs

from .browser import WEB
from .decoding import Node, check_clip

GOLDEN = WEB.parents[1] / "tests" / "codec" / "golden4.kcgs"


def random_still(generator: np.random.Generator, size: tuple[int, int], channels: int, regions: int) -> Scene:
    """Gaussians in cells about random points, whose contours have one width or several."""
    field = GaussianField.random(40, size, channels=channels, seed=int(generator.integers(1000)))
    if regions == 1:
        return Scene(field)
    rows, columns = np.mgrid[: size[0], : size[1]]
    places = generator.integers(0, size, (regions, 2))
    nearest = ((rows[..., None] - places[:, 0]) ** 2 + (columns[..., None] - places[:, 1]) ** 2).argmin(-1)
    labels = torch.from_numpy(3 * nearest + 2)
    softness: float | dict[tuple[int, int], float] = 1.3
    if generator.random() < 0.5:
        softness = {pair: float(generator.choice([0.0, 0.25, 2.0])) for pair in sorted(touching_pairs(labels))}
    region_map = RegionMap.from_labels(labels, softness)
    ids = region_map.ids[torch.from_numpy(generator.integers(0, region_map.num_regions, 40))]
    return Scene(GaussianField(field.means, field.cholesky, field.merged_colors(), ids, size=size), region_map)


def random_map(generator: np.random.Generator, index: np.ndarray, regions: int) -> np.ndarray:
    """A map that follows: the predicted one, or one with blots, specks, or noise."""
    index, (height, width) = index.copy(), index.shape
    kind = generator.integers(6)
    for _ in range(3 if 0 < kind < 5 else 0):
        y, x = generator.integers(0, height), generator.integers(0, width)
        index[y : y + generator.integers(1, 9), x : x + generator.integers(1, 9)] = generator.integers(regions)
    if kind == 5:
        index = generator.integers(0, regions, index.shape).astype(np.int32)
    return index


def random_change(part: ClipPart, generator: np.random.Generator, qp: int, numbers: np.ndarray) -> Change:
    moved, index = part.moved(numbers)
    region, ids = part.frame.region, len(part.ids)
    present = np.zeros(1, np.int64)
    if index is not None:
        index = random_map(generator, index, ids)
        present = np.unique(index).astype(np.int64)
    left = ~np.isin(region, present)
    gone = (generator.random(len(region)) < 0.1) & ~left
    base = Parameters(*(numbers[~(gone | left)] for numbers in moved))
    codes = np.round(generator.laplace(size=(len(base.means), 5 + part.channels)) * generator.choice([0.0, 1.0, 20.0]))
    codes *= (generator.random(len(codes)) < 0.6)[:, None]
    most = 1.5 / Differences(base, Quantizer(qp, part.size).distortion, part.size).steps
    codes = np.clip(codes, -most, most).astype(np.int64)
    count = int(generator.choice([0, 2, 9]))
    new = GaussianField.random(max(count, 1), part.size, channels=part.channels, seed=int(generator.integers(1000)))
    born = Parameters(*(t.detach().double().numpy()[:count] for t in (new.means, new.cholesky, new.merged_colors())))
    born_region = generator.choice(present, count).astype(np.int64)
    return Change(index, gone, codes, born_codes(born, qp, part.size), born_region)


def random_clip(seed: int) -> tuple[ClipHeader, list[Record]]:
    """Two parts of any regions, whose regions move, shrink and grow."""
    generator = np.random.default_rng(seed)
    size = int(generator.integers(2, 50)), int(generator.integers(2, 70))
    channels, regions = 1 + seed % 4, [1, 2, 3, 6][seed // 4 % 4]
    header = ClipHeader(size, channels, 24)
    reader, records = FrameReader(header), []
    for number in range(10):
        if number in (0, 6):
            records.append(key_record(encode(random_still(generator, size, channels, regions), quality=35)))
            reader.read(records[-1])
            continue
        assert reader.part is not None
        numbers = reader.part.motions.last.copy()
        moving = generator.random(len(numbers)) < 0.7
        most = [600, 600, 40, 600, 600, 40]
        numbers[moving] = np.round(generator.laplace(size=(moving.sum(), 6)) * most).clip(-2500, 2500)
        qp = int(generator.integers(100, 300))
        records.append(carried_record(reader.part, qp, numbers, random_change(reader.part, generator, qp, numbers)))
    return header, records


def packed(header: ClipHeader, records: list[Record]) -> bytes:
    frames = (pack_record(record, number) for number, record in enumerate(records))
    return b"".join([pack_header(header), *frames, pack_end(len(records))])


def attack(node: Node, count: int, seed: int) -> None:
    """Damage frames under checksums that are right, or the file: both decoders agree on what is left."""
    generator, frames, refused = random.Random(seed), 0, 0
    clips = [unpack(GOLDEN.read_bytes())[:2], *(random_clip(seed + i) for i in (4, 8, 12))]
    for _ in range(count):
        header, records = generator.choice(clips)
        records = list(records)
        number = generator.randrange(1, len(records))
        content = bytearray(records[number].data)
        for _ in range(generator.choice([1, 2, len(content) // 2])):
            content[generator.randrange(len(content))] = generator.randrange(256)
        records[number] = Record(records[number].kind, bytes(content[: generator.choice([len(content), number])]))
        found = check_clip(node, packed(header, records))
        frames += found
        refused += found < len(records)
    assert frames and refused


def assert_same_container(node: Node, data: bytes) -> None:
    """Both take a file apart into as many frames, say whether it is whole, or refuse it; no frame is decoded."""
    answer = node.do("clip", data, numbers=[])
    try:
        _, records, complete = unpack(data)
    except CodecError as error:
        assert answer.get("error") == "DecodeError", (str(error), answer)
        return
    if records:
        assert (answer.get("frames"), answer.get("complete")) == (len(records), complete), answer
    else:
        assert answer["error"] == "DecodeError" and "it holds no whole frame" in answer["message"]


class TestConformance:
    def test_golden(self, node: Node) -> None:
        assert check_clip(node, GOLDEN.read_bytes()) == 5

    @pytest.mark.parametrize("seed", range(16))
    def test_random_clips(self, node: Node, seed: int) -> None:
        assert check_clip(node, packed(*random_clip(seed))) == 10

    @pytest.mark.slow
    def test_a_hundred(self, node: Node) -> None:
        for seed in range(16, 116):
            assert check_clip(node, packed(*random_clip(seed))) == 10, seed

    def test_frames_in_any_order(self, node: Node) -> None:
        data = packed(*random_clip(13))
        first = node.do("clip", data)["described"]
        order = [7, 2, 9, 0, 5, 5, 6, 3]
        answer = node.do("clip", data, numbers=order)["described"]
        for number, found in zip(order, answer, strict=True):
            expected = dict(first[number])
            for described in (found, expected):  # a part that is read again counts on
                described.pop("keys")
            assert found == expected


class TestDamage:
    def test_fifty(self, node: Node) -> None:
        attack(node, 50, 0)

    @pytest.mark.slow
    def test_a_thousand(self, node: Node) -> None:
        attack(node, 1000, 1000)

    def test_a_file_that_ends_early(self, node: Node) -> None:
        data = GOLDEN.read_bytes()
        found = {check_clip(node, data[:end]) for end in [*range(0, len(data), 37), len(data) - 1]}
        assert found == {0, 1, 2, 3, 4, 5}

    @pytest.mark.parametrize("mask", [1, 0x80, 0xFF])
    def test_damage_of_the_last_bytes(self, node: Node, mask: int) -> None:
        data = GOLDEN.read_bytes()
        for place in range(len(data) - 20, len(data)):
            damaged = bytearray(data)
            damaged[place] ^= mask
            for end in (len(data) - 1, len(data)):
                assert_same_container(node, bytes(damaged[:end]))
            assert_same_container(node, bytes(damaged) + b"\0")

    @pytest.mark.slow
    def test_every_end(self, node: Node) -> None:
        data = GOLDEN.read_bytes()
        for end in range(len(data) + 1):
            assert_same_container(node, data[:end])

    def test_what_is_wrong_is_named(self, node: Node, tmp_path: Path) -> None:
        data = GOLDEN.read_bytes()
        header, records, _ = unpack(data)
        for content, message in [
            (data[:-60] + bytes([data[-60] ^ 1]) + data[-59:], "the checksum of frame 4 is another"),
            (data[:5] + bytes([data[5] ^ 1]) + data[6:], "damaged: the checksum of its header is another"),
            (data + b"\0", f"the clip must end after {len(data)} bytes; got {len(data) + 1}"),
            (packed(header, records[1:]), "the first frame of a clip must be a key frame"),
            (packed(header, []), "it holds no whole frame"),
            (records[0].data, "a clip has version 4; got 3"),
            (packed(ClipHeader((40, 61), 3, 24), records), "a key frame must be 40 x 61"),
        ]:
            answer = node.do("clip", content)
            assert answer["error"] == "DecodeError" and message in answer["message"], answer

    def test_a_bad_frame_is_named(self, node: Node) -> None:
        header, records, _ = unpack(GOLDEN.read_bytes())
        data = packed(header, [*records[:3], Record(records[3].kind, b""), records[4]])
        for number in (3, 4):
            answer = node.do("clip", data, numbers=[number])
            assert answer["error"] == "DecodeError" and answer["message"].startswith("frame 3: "), answer
