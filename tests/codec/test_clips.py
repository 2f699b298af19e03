"""Clips as files: what is written is read, and what is damaged is refused."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kcgs import Clip, GaussianField, Scene, load
from kcgs.codec import CodecError, encode
from kcgs.codec.clips.carried import Change, ClipPart, born_codes
from kcgs.codec.clips.differences import DifferenceCoder, Differences
from kcgs.codec.clips.file import CARRIED, ClipHeader, Record, pack_end, pack_header, pack_record, unpack
from kcgs.codec.clips.frames import FrameReader, carried_record, key_record
from kcgs.codec.clips.motion import MotionCoder, expand, move_gaussians, quantize_motion
from kcgs.codec.gaussians.quantize import Parameters, Quantizer
from kcgs.codec.rangecoder import Reader, Writer

SIZE = (40, 60)
QP = 240


def labels() -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    return ((x - 25) ** 2 + (y - 20) ** 2 < 120).long() * 4


def still(seed: int = 0, *, mapped: bool = True) -> Scene:
    regions = labels() if mapped else None
    return Scene(GaussianField.random(60, SIZE, regions=regions, seed=seed), regions)


def change_of(part: ClipPart, seed: int, numbers) -> Change:
    """Return a random change of the next frame."""
    rng = np.random.default_rng(seed)
    _, index = part.moved(numbers)
    region = part.frame.region
    gone = rng.random(len(region)) < 0.1
    left = np.zeros(len(region), bool) if index is None else ~np.isin(region, np.unique(index))
    gone &= ~left
    stays = ~(gone | left)
    codes = np.round(rng.laplace(size=(stays.sum(), 5 + part.channels)) * rng.choice([0, 2.0, 20.0])).astype(np.int64)
    base = part.moved(numbers)[0]
    kept = Parameters(*(t[stays] for t in base))
    largest = 30.0 / Differences(kept, Quantizer(QP, SIZE).distortion, SIZE).steps
    codes = np.clip(codes, -largest // 20, largest // 20).astype(np.int64)
    new = GaussianField.random(3, SIZE, seed=seed)
    born = Parameters(*(t.detach().double().numpy() for t in (new.means, new.cholesky, new.merged_colors())))
    present = np.zeros(1, np.int64) if index is None else np.unique(index).astype(np.int64)
    return Change(index, gone, codes, born_codes(born, QP, SIZE), rng.choice(present, 3).astype(np.int64))


def clip_of(frames: int, *, mapped: bool = True) -> Clip:
    scene, header = still(mapped=mapped), ClipHeader(SIZE, 3, 24)
    reader = FrameReader(header)
    records = [key_record(encode(scene, quality=40))]
    reader.read(records[0])
    for number in range(1, frames):
        numbers = np.tile(np.array([[3, -2, 8, 1, 0, -16]]), (len(reader.part.ids), 1)) * (number % 3)
        records.append(carried_record(reader.part, QP, numbers, change_of(reader.part, number, numbers)))
    return Clip(header, records)


@pytest.mark.parametrize("mapped", [True, False])
def test_a_reader_finds_what_the_writer_has(mapped: bool) -> None:
    scene, header = still(mapped=mapped), ClipHeader(SIZE, 3, 24)
    writer, reader = FrameReader(header), FrameReader(header)
    record = key_record(encode(scene, quality=40))
    writer.read(record)
    reader.read(record)
    for number in range(1, 6):
        numbers = np.random.default_rng(number).integers(-9, 9, (len(writer.part.ids), 6))
        change = change_of(writer.part, number, numbers)
        found = reader.read(carried_record(writer.part, QP, numbers, change))
        for mine, theirs in zip(writer.part.frame.gaussians, found.gaussians, strict=True):
            assert mine.dtype == np.float32 and (mine == theirs).all()
        assert (writer.part.frame.key == found.key).all() and (writer.part.frame.region == found.region).all()
        assert (found.index is None) == (not mapped) and (not mapped or (found.index == change.index).all())
        assert len(np.unique(found.key)) == len(found.key)


def test_an_unchanged_frame_takes_a_few_bytes_and_unchanged_gaussians_under_a_bit() -> None:
    clip = clip_of(1)
    reader = FrameReader(ClipHeader(SIZE, 3, 24))
    scene = Scene(GaussianField.random(2000, SIZE, seed=1))
    reader.read(key_record(encode(scene, quality=40)))
    part = reader.part
    none = Parameters(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3)))
    sizes = []
    for _ in range(4):
        count = len(part.frame.region)
        codes = np.zeros((count, 8), np.int64)
        change = Change(None, np.zeros(count, bool), codes, born_codes(none, QP, SIZE), np.zeros(0, np.int64))
        sizes.append(len(carried_record(part, QP, np.zeros((1, 6), np.int64), change).data))
    assert sizes[-1] * 8 < 0.1 * count and clip.num_bytes < 2000


def test_a_clip_of_earlier_days_reads_as_it_did() -> None:
    clip = Clip.load(Path(__file__).with_name("golden4.kcgs"))
    digest = hashlib.sha256()
    for scene in clip:
        assert scene.regions is not None
        field = scene.field
        for tensor in (field.means, field.cholesky, field.colors, field.region_ids, scene.regions.labels):
            digest.update(tensor.detach().numpy().tobytes())
    assert digest.hexdigest() == "a6df276db9afded6e76e471b79a7e31dcd6785943c522aed6f0f5c29004c6d19"


def test_frames_can_be_read_in_any_order() -> None:
    clip = clip_of(6)
    first = [scene.render() for scene in clip]
    for number in (4, 1, 5, 0, 3, 3, 2, -1):
        assert torch.equal(clip[number].render(), first[number])
    again = Clip.from_bytes(clip.to_bytes())
    assert again.to_bytes() == clip.to_bytes() and torch.equal(again[5].render(), first[5])
    assert len(clip.to_bytes()) == clip.num_bytes
    with pytest.raises(IndexError, match="-6 to 5"):
        clip[6]
    with pytest.raises(TypeError, match="int"):
        clip[1.5]


def test_motions_are_exact_and_invert() -> None:
    matrix = np.array([[1.01, 0.02, -3.5], [-0.01, 0.99, 2.25]])
    numbers = quantize_motion(matrix, SIZE)
    a, b, c, d, e, f = (expand(numbers[None], SIZE)[0] / 65536).tolist()
    centre = np.array([30.0, 20.0])
    assert np.allclose(np.array([[a, b], [d, e]]), matrix[:, :2], atol=1 / 16384)
    assert np.allclose(np.array([[a, b], [d, e]]) @ centre + [c, f], matrix[:, :2] @ centre + matrix[:, 2], atol=1 / 16)
    gaussians = Parameters(np.array([[12.0, 7.0]]), np.array([[2.0, 0.5, 1.0]]), np.ones((1, 3)))
    moved = move_gaussians(gaussians, np.zeros(1, np.int64), expand(numbers[None], SIZE))
    back = np.array([[a, b], [d, e]])
    assert np.allclose(back @ moved.means[0] + [c, f], [12.0, 7.0])
    factor, before = (np.array([[m[0], 0], [m[1], m[2]]]) for m in (moved.cholesky[0], gaussians.cholesky[0]))
    assert np.allclose(back @ factor @ factor.T @ back.T, before @ before.T)


def test_differences_go_there_and_back() -> None:
    rng = np.random.default_rng(0)
    field = GaussianField.random(50, SIZE, seed=0)
    base = Parameters(*(t.detach().double().numpy() for t in (field.means, field.cholesky, field.merged_colors())))
    differences = Differences(base, 2.0**-12, SIZE)
    codes = rng.integers(-3, 4, (50, 8))
    restored = differences.restore(codes)
    again = differences.measure(Parameters(*(t.astype(np.float64) for t in restored)))
    assert np.allclose(again, codes, atol=1e-3)
    same = differences.restore(np.zeros((50, 8), np.int64))
    assert all((mine == theirs.astype(np.float32)).all() for mine, theirs in zip(same, base, strict=True))


@settings(max_examples=25)
@given(st.integers(0, 300), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_any_whole_numbers_are_coded(count: int, channels: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(2):
        codes = np.round(rng.standard_cauchy((count, 5 + channels)) * rng.integers(0, 9)).clip(-(2**20), 2**20)
        frames.append((rng.integers(0, 6, count), rng.integers(0, 4, count), codes.astype(np.int64)))
    writer, coder = Writer(), DifferenceCoder(channels)
    for strength, activity, codes in frames:
        coder.code(writer, strength, activity, codes)
    reader, coder = Reader(writer.finish()), DifferenceCoder(channels)
    for strength, activity, codes in frames:
        assert (coder.code(reader, strength, activity, None) == codes).all()


def test_motions_of_many_regions_are_coded() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(-40, 40, (30, 6)) * (rng.random((30, 1)) < 0.5) for _ in range(3)]
    writer, coder = Writer(), MotionCoder(30)
    for numbers in frames:
        coder.code(writer, SIZE, numbers)
    reader, coder = Reader(writer.finish()), MotionCoder(30)
    for numbers in frames:
        assert (coder.code(reader, SIZE, None) == expand(numbers, SIZE)).all() and (coder.last == numbers).all()


def test_a_clip_that_ends_early_loses_only_what_follows() -> None:
    clip = clip_of(4)
    data, ends = clip.to_bytes(), np.cumsum([len(pack_header(ClipHeader(SIZE, 3, 24))), *clip.frame_bytes])
    for length in range(len(data)):
        whole = int((ends[1:] <= length).sum())
        if whole == 0:
            with pytest.raises(CodecError):
                Clip.from_bytes(data[:length], whole=False)
            continue
        part = Clip.from_bytes(data[:length], whole=False)
        assert len(part) == whole
        with pytest.raises(CodecError, match="ends early"):
            Clip.from_bytes(data[:length])
    assert torch.equal(part[2].render(), clip[2].render())


def test_every_damaged_byte_is_found() -> None:
    data = clip_of(3).to_bytes()
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 1 << position % 8
        with pytest.raises(CodecError):
            Clip.from_bytes(bytes(damaged))


def test_frames_in_another_order_are_found() -> None:
    clip = clip_of(4)
    header, records, _ = unpack(clip.to_bytes())
    parts = [pack_record(record, number) for number, record in enumerate(records)]
    with pytest.raises(CodecError, match="checksum of frame 1"):
        unpack(b"".join([pack_header(header), parts[0], parts[2], parts[1], parts[3], pack_end(4)]))


@settings(max_examples=60)
@given(st.binary(max_size=60), st.booleans())
def test_frames_of_any_bytes_are_read_or_refused(content: bytes, mapped: bool) -> None:
    records = [key_record(encode(still(mapped=mapped), quality=40)), Record(CARRIED, content)]
    clip = Clip(ClipHeader(SIZE, 3, 24), records)
    with contextlib.suppress(CodecError):
        assert torch.isfinite(clip[1].render()).all()


def test_a_still_is_no_clip_and_a_clip_no_still(tmp_path) -> None:
    clip = clip_of(2)
    with pytest.raises(CodecError, match="version 4"):
        Clip.from_bytes(encode(still(), quality=40))
    with pytest.raises(CodecError, match="start with"):
        Clip.from_bytes(b"hello, this is text")
    clip.save(tmp_path / "clip.kcgs")
    assert Clip.load(tmp_path / "clip.kcgs").to_bytes() == clip.to_bytes()
    with pytest.raises(ValueError, match="clip"):
        load(tmp_path / "clip.kcgs")
    with pytest.raises(ValueError, match=r"\.kcgs"):
        clip.save(tmp_path / "clip.mp4")


def test_key_frames_must_fit_the_header() -> None:
    other = key_record(encode(Scene(GaussianField.random(9, (8, 8), seed=0)), quality=40))
    with pytest.raises(CodecError, match="key frame must be"):
        _ = Clip(ClipHeader(SIZE, 3, 24), [other])[0]


def test_between_frames_gaussians_are_on_their_way() -> None:
    clip = clip_of(3)
    assert torch.equal(clip.at(1).render(), clip[1].render())
    near, far = (float((clip.at(t).render() - clip[1].render()).square().mean()) for t in (1.001, 1.5))
    assert near < far
    assert clip.render(0.5, size=(80, 120)).shape == (3, 80, 120)
    with pytest.raises(ValueError, match="time"):
        clip.at(2.5)


def test_editing_nothing_changes_next_to_nothing_and_edits_hold() -> None:
    clip = clip_of(4)
    same = clip.edit(lambda scene: scene)
    assert same.key_frames == clip.key_frames
    for mine, theirs in zip(same, clip, strict=True):
        assert float((mine.render() - theirs.render()).abs().mean()) < 0.02
    with pytest.raises(TypeError, match="frame 0"):
        clip.edit(lambda scene: scene.render())


class LowWriter(Writer):
    """Names an energy for new Gaussians that none has."""

    def number(self, value: int, size: int) -> int:
        super().number(5 if size == 128 else value, size)
        return value


def test_new_gaussians_of_an_energy_that_none_has_are_refused() -> None:
    header, records, _ = unpack(clip_of(1, mapped=False).to_bytes())
    reader, other = FrameReader(header), FrameReader(header)
    reader.read(records[0])
    other.read(records[0])
    numbers, writer = np.zeros((1, 6), np.int64), LowWriter()
    reader.part.code(writer, QP, numbers, change_of(reader.part, 1, numbers))
    with pytest.raises(CodecError, match="a class of energy must be -24 to 40; got -59"):
        other.part.code(Reader(writer.finish()), QP, None, None)


def test_an_edit_that_takes_the_map_away_begins_a_key_frame() -> None:
    clip, seen = clip_of(3), []

    def edit(scene: Scene) -> Scene:
        seen.append(scene)
        return scene if len(seen) < 3 else Scene(GaussianField.random(20, SIZE, seed=0))

    assert clip.edit(edit).key_frames == (0, 2)


def test_what_an_edit_makes_anew_is_as_fine_as_a_key_frame() -> None:
    made = [Scene(GaussianField.random(60, SIZE, seed=seed)) for seed in range(3)]
    numbered = iter(made)
    edited = clip_of(3, mapped=False).edit(lambda scene: next(numbered))
    assert edited.key_frames == (0,)
    errors = [float((a.render() - b.render()).square().mean()) for a, b in zip(edited, made, strict=True)]
    assert max(errors[1:]) < 2 * errors[0]


def test_an_edit_may_make_gaussians_as_thin_as_it_likes() -> None:
    def thin(scene: Scene) -> Scene:
        scene.field.cholesky.data[:, 2] *= 1e-6
        return scene

    edited = clip_of(3).edit(thin)
    for scene in Clip.from_bytes(edited.to_bytes()):
        assert scene.field.cholesky[:, ::2].min() > 1e-3
