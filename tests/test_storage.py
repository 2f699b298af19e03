"""Scenes on disk: exact, deterministic, whole, and refused when damaged."""

import json
import random
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors
import safetensors.torch
import torch
from torch import Tensor

import kcgs
from kcgs import GaussianField, RegionMap, Scene, load, save
from kcgs.storage import FORMAT, MAX_SIDE

SIZE = (9, 11)
Softness = float | dict[tuple[int, int], float]
TENSORS = ("means", "cholesky", "colors", "region_ids", "opacities")


def labels_with(highest: int, size: tuple[int, int] = SIZE) -> Tensor:
    labels = torch.arange(size[0] * size[1]).reshape(size) // 20
    labels[labels == labels.max()] = highest
    return labels


def make_field(
    *, highest: int = 7, opacities: bool = True, dtype: torch.dtype = torch.float32, channels: int = 3
) -> GaussianField:
    generator = torch.Generator().manual_seed(0)
    field = GaussianField.random(13, SIZE, channels=channels, seed=1, dtype=dtype)
    ids = torch.randint(0, 4, (13,), generator=generator)
    ids[3] = highest
    return GaussianField(
        field.means.detach(),
        field.cholesky.detach(),
        field.colors.detach(),
        ids,
        torch.rand(13, generator=generator, dtype=dtype) if opacities else None,
        size=SIZE,
    )


def same_bits(first: Tensor | None, second: Tensor | None) -> bool:
    if first is None or second is None:
        return first is second
    if first.dtype != second.dtype or first.shape != second.shape:
        return False
    raw = [t.detach().contiguous().view(torch.uint8) for t in (first, second)]
    return torch.equal(*raw)


def assert_same_scene(scene: Scene, field: GaussianField, regions: RegionMap | None) -> None:
    for name in TENSORS:
        assert same_bits(getattr(scene.field, name), getattr(field, name)), name
    assert scene.field.size == field.size
    if regions is None:
        assert scene.regions is None
    else:
        assert scene.regions is not None
        assert same_bits(scene.regions.labels, regions.labels)
        assert scene.regions.softness == regions.softness
        assert type(scene.regions.softness) is type(regions.softness)


def read_header(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    end = 8 + struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8:end]), content[end:]


def read_notes(path: Path) -> dict[str, Any]:
    (notes,) = read_header(path)[0]["__metadata__"].values()
    return json.loads(notes)  # type: ignore[no-any-return]


def write_header(path: Path, header: dict[str, Any], body: bytes) -> None:
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.safetensors"


@pytest.fixture
def saved(path: Path) -> Path:
    save(path, Scene(make_field(), RegionMap.from_labels(labels_with(7), 0.75), metadata={"title": "a"}))
    return path


class TestRoundTrip:
    @pytest.mark.parametrize("softness", [0.0, 0.7, 1 / 3])
    @pytest.mark.parametrize("opacities", [False, True])
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_bit_for_bit(self, path: Path, softness: float, opacities: bool, dtype: torch.dtype) -> None:
        field = make_field(opacities=opacities, dtype=dtype)
        with torch.no_grad():
            field.colors[0, 0], field.colors[0, 1] = -0.0, 1e-42 if dtype == torch.float32 else 5e-324
        regions = RegionMap.from_labels(labels_with(7), softness)
        assert save(path, Scene(field, regions)) == path.stat().st_size
        scene = load(path)
        assert_same_scene(scene, field, regions)
        assert scene.metadata == {}

    @pytest.mark.parametrize("batched", [False, True])
    @pytest.mark.parametrize("softness", [0.0, 0.7, {(0, 1): 1 / 3, (2, 1): 1.25, (3, 7): 0.0}])
    def test_widths_of_pairs(self, path: Path, softness: Softness, batched: bool) -> None:
        labels = labels_with(7)
        regions = RegionMap.from_labels(labels[None] if batched else labels, softness)
        save(path, Scene(make_field(), regions))
        scene = load(path)
        assert_same_scene(scene, make_field(), regions)
        first, second = (Scene(make_field(), r)() for r in (regions, scene.regions))
        assert torch.equal(first, second)

    @pytest.mark.parametrize("channels", [1, 4])
    def test_without_regions(self, path: Path, channels: int) -> None:
        field = make_field(channels=channels)
        save(path, Scene(field))
        assert_same_scene(load(path), field, None)

    def test_without_region_ids(self, path: Path) -> None:
        field = GaussianField.random(5, (4, 6), seed=0)
        save(path, Scene(field))
        assert_same_scene(load(path), field, None)

    def test_label_map_tensor_means_hard_contours(self, path: Path) -> None:
        save(path, Scene(make_field(), labels_with(7).to(torch.int16)))
        assert_same_scene(load(path), make_field(), RegionMap.from_labels(labels_with(7)))

    @pytest.mark.parametrize("batched_labels", [False, True])
    def test_batch(self, path: Path, batched_labels: bool) -> None:
        one = make_field()
        stacked = [torch.stack([getattr(one, name).detach()] * 2) for name in TENSORS]
        stacked[0][1] += 1.5
        field = GaussianField(*stacked, size=SIZE)
        labels = torch.stack([labels_with(7), labels_with(7).flip(0)]) if batched_labels else labels_with(7)
        save(path, Scene(field, labels))
        assert_same_scene(load(path), field, RegionMap.from_labels(labels))

    def test_no_gaussians(self, path: Path) -> None:
        field = make_field().subset(torch.zeros(13, dtype=torch.bool))
        save(path, Scene(field, labels_with(7)))
        assert load(path).num_gaussians == 0
        assert_same_scene(load(path), field, RegionMap.from_labels(labels_with(7)))

    def test_tensors_in_one_storage_or_strided(self, path: Path) -> None:
        block = torch.rand(6, 8) + 0.5
        names = ("means", "cholesky", "colors")
        parts = [torch.nn.Parameter(part) for part in block.split([2, 3, 3], dim=1)]
        field = GaussianField(*parts, size=SIZE)
        assert not any(getattr(field, name).is_contiguous() for name in names)
        save(path, Scene(field))
        assert_same_scene(load(path), field, None)

    def test_renders_the_same_image(self, saved: Path) -> None:
        scene = load(saved)
        expected = Scene(make_field(), RegionMap.from_labels(labels_with(7), 0.75))()
        image = scene()
        assert torch.equal(image, expected)
        assert image.std() > 0.01

    def test_loaded_field_can_be_trained(self, saved: Path) -> None:
        scene = load(saved)
        scene().sum().backward()
        assert scene.field.colors.grad is not None and scene.field.colors.grad.abs().max() > 0

    def test_loaded_scene_does_not_depend_on_the_file(self, path: Path) -> None:
        regions = RegionMap.from_labels(labels_with(1 << 40))  # int64, which needs no conversion
        save(path, Scene(make_field(highest=1 << 40), regions))
        scene = load(path)
        content = path.read_bytes()
        with path.open("r+b") as file:
            file.write(b"\0" * len(content))
        assert_same_scene(scene, make_field(highest=1 << 40), regions)


class TestFormat:
    @pytest.mark.parametrize(
        ("highest", "dtype"),
        [
            (255, "U8"),
            (256, "U16"),
            (65535, "U16"),
            (65536, "I32"),
            (2**31 - 1, "I32"),
            (2**31, "I64"),
            (2**62, "I64"),
        ],
    )
    def test_smallest_integers(self, path: Path, highest: int, dtype: str) -> None:
        regions = RegionMap.from_labels(labels_with(highest))
        save(path, Scene(make_field(highest=highest), regions))
        header, _ = read_header(path)
        assert header["region_ids"]["dtype"] == dtype
        assert read_notes(path)["labels"]["dtype"] == dtype.replace("U", "uint").replace("I", "int")
        assert_same_scene(load(path), make_field(highest=highest), regions)

    def test_any_reader_finds_everything(self, saved: Path) -> None:
        with safetensors.safe_open(saved, framework="numpy") as file:
            assert sorted(file.keys()) == ["cholesky", "colors", "labels", "means", "opacities", "region_ids"]
            (name,) = file.metadata()
            assert name == FORMAT and json.loads(file.metadata()[name]) == {
                "version": 1,
                "kcgs_version": kcgs.__version__,
                "size": [9, 11],
                "softness": 0.75,
                "labels": {"dtype": "uint8", "shape": [9, 11]},
                "notes": {"title": "a"},
            }

    @pytest.mark.parametrize("highest", [7, 300, 70_000, 1 << 40])
    @pytest.mark.parametrize("kind", ["plain", "pairs", "batch"])
    def test_maps_are_small(self, path: Path, highest: int, kind: str) -> None:
        labels = labels_with(highest, (45, 55))
        softness: Softness = {(0, 1): 0.25} if kind == "pairs" else 0.0
        labels = torch.stack([labels, labels.flip(1)]) if kind == "batch" else labels
        regions = RegionMap.from_labels(labels, softness)
        field = GaussianField.random(5, (45, 55), seed=0)
        if kind == "batch":
            parts = (field.means, field.cholesky, field.colors)
            field = GaussianField(*(t.detach().expand(2, -1, -1) for t in parts), size=(45, 55))
        scene = Scene(field, regions)
        assert save(path, scene) < 5 * 32 + 1_200 + (160 if kind == "batch" else 0)
        assert read_notes(path)["labels"]["shape"] == list(labels.shape)
        assert_same_scene(load(path), scene.field, regions)

    def test_absent_things_take_no_room(self, path: Path) -> None:
        save(path, Scene(make_field(opacities=False)))
        header, body = read_header(path)
        assert header.keys() == {"__metadata__", "means", "cholesky", "colors", "region_ids"}
        assert len(body) == 13 * (8 * 4 + 1)
        assert not {"softness", "labels"} & read_notes(path).keys()

    def test_header_keeps_floats_aligned(self, path: Path) -> None:
        for length in range(8):
            save(path, Scene(make_field(), metadata={"title": "x" * length}))
            assert struct.unpack("<Q", path.read_bytes()[:8])[0] % 8 == 0

    def test_metadata(self, path: Path) -> None:
        notes = {"ü\n\"'\\": "\0 é 🖼", "format": "mine", "": "", "user.user.": "x", "height": "-1"}
        save(path, Scene(make_field(), metadata=notes))
        assert load(path).metadata == notes

    def test_same_scene_same_bytes(self, tmp_path: Path) -> None:
        notes = {name: name for name in "qwertyuiop"}
        contents = set()
        for turn in range(8):
            target = tmp_path / f"{turn}.safetensors"
            ordered = dict(sorted(notes.items(), reverse=bool(turn % 2)))
            save(target, Scene(make_field(), labels_with(7), metadata=ordered))
            contents.add(target.read_bytes())
        assert len(contents) == 1

    def test_same_bytes_from_another_process(self, saved: Path, tmp_path: Path) -> None:
        again = tmp_path / "again.safetensors"
        code = "import sys; from kcgs import load, save; save(sys.argv[2], load(sys.argv[1]))"
        subprocess.run([sys.executable, "-c", code, str(saved), str(again)], check=True)
        assert again.read_bytes() == saved.read_bytes()


class TestSaveRefuses:
    @pytest.mark.parametrize("name", ["scene", "scene.pt", "scene.safetensors.png", "safetensors"])
    def test_other_suffixes(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(ValueError, match=r"path must end in \.safetensors or \.kcgs; got"):
            save(tmp_path / name, Scene(make_field()))
        assert list(tmp_path.iterdir()) == []

    def test_wrong_types(self, path: Path) -> None:
        field = make_field()
        with pytest.raises(TypeError, match="field must be a GaussianField; got dict"):
            save(path, Scene({"means": field.means}))  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="regions must be a RegionMap, a label map or None; got list"):
            save(path, Scene(field, [[0, 1]]))  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="metadata must map str to str; got 'n': 3"):
            save(path, Scene(field, metadata={"n": 3}))  # type: ignore[dict-item]
        with pytest.raises(TypeError, match="metadata must map str to str; got str"):
            save(path, Scene(field, metadata="title"))  # type: ignore[arg-type]
        assert not path.exists()

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("means", float("nan"), "means must be finite"),
            ("colors", float("inf"), "colors must be finite"),
            ("opacities", float("-inf"), "opacities must be finite"),
            ("cholesky", 0.0, "cholesky must have l11 > 0"),
        ],
    )
    def test_what_load_would_refuse(self, saved: Path, name: str, value: float, message: str) -> None:
        before = saved.read_bytes()
        field = make_field()
        with torch.no_grad():
            getattr(field, name)[2] = value
        with pytest.raises(ValueError, match=message):
            save(saved, Scene(field))
        assert saved.read_bytes() == before
        assert list(saved.parent.iterdir()) == [saved]

    def test_absurd_sizes(self, path: Path) -> None:
        field = GaussianField.random(3, (4, MAX_SIDE + 1), seed=0)
        with pytest.raises(ValueError, match=r"width must be in \[1, 1048576\]; got 1048577"):
            save(path, Scene(field))

    def test_missing_folder(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match="nowhere"):
            save(tmp_path / "nowhere" / "scene.safetensors", Scene(make_field()))


def _note(**changes: Any) -> Callable[[dict[str, Any]], None]:
    """Change entries of the JSON object; None: leave it out."""

    def edit(header: dict[str, Any]) -> None:
        notes = json.loads(header["__metadata__"][FORMAT]) | changes
        kept = {name: value for name, value in notes.items() if value is not None}
        header["__metadata__"][FORMAT] = json.dumps(kept)

    return edit


def _text(text: str) -> Callable[[dict[str, Any]], None]:
    return lambda header: header["__metadata__"].update({FORMAT: text})


def _entry(name: str, **changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda header: header[name].update(changes)


class TestLoadRefuses:
    def test_missing_file_and_folder(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"absent\.safetensors"):
            load(tmp_path / "absent.safetensors")
        with pytest.raises(ValueError, match=r"path must end in \.safetensors or \.kcgs; got"):
            load(tmp_path)

    @pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + bytes(100), b"\x80\x04}q\0.", b"\xff" * 64])
    def test_foreign_files(self, path: Path, content: bytes) -> None:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"^cannot load {path}: "):
            load(path)

    def test_other_safetensors(self, path: Path) -> None:
        safetensors.torch.save_file({"means": torch.rand(3, 2)}, path)
        with pytest.raises(ValueError, match=r"its metadata must have an entry 'kcgs\.scene'; got \[\]"):
            load(path)

    @pytest.mark.parametrize(
        ("edit", "message"),
        [
            (lambda header: header.update(__metadata__={"format": "pt"}), r"an entry 'kcgs\.scene'; got \['format'\]"),
            (_text("{"), "Expecting property name"),
            (_text("[]"), "list indices must be"),
            (_text("[" * 100_000), "recursion"),
            (_note(version=2), "its version must be 1; got 2"),
            (_note(version=None), "its 'kcgs.scene' must have an entry 'version'"),
            (_note(size=None), "its 'kcgs.scene' must have an entry 'size'"),
            (_note(size=[0, 11]), r"height must be in \[1, 1048576\]; got 0"),
            (_note(size=[9, 1 << 21]), r"width must be in \[1, 1048576\]; got 2097152"),
            (_note(size=[9, 11.0]), "width must be an integer; got 11.0"),
            (_note(size=[9]), "not enough values"),
            (_note(softness=None), "its 'kcgs.scene' must have an entry 'softness'"),
            (_note(softness="wide"), "softness must be"),
            (_note(softness=-1), "softness must be in"),
            (_note(softness=float("nan")), "softness must be in"),
            (_note(softness=[[0, 1]]), "not enough values"),
            (_note(softness=[1]), "unpack"),
            (_note(softness=[[0, 1, "a"]]), "softness of"),
            (_note(softness=[[[0], 1, 0.5]]), "unhashable"),
            (_note(softness=[[0, 1.5, 0.5]]), "softness must map pairs of ids"),
            (_note(softness=[[0, 99, 0.5]]), r"softness must map pairs of two different ids in the map; got \(0, 99\)"),
            (_note(softness=[[0, 1, float("inf")]]), r"softness of \(0, 1\) must be in"),
            (_note(labels=None), "its 'kcgs.scene' must have an entry 'labels'"),
            (_note(labels={"shape": [9, 11]}), "missing 1 required positional argument: 'dtype'"),
            (_note(labels={"dtype": "float32", "shape": [9, 11]}), "labels must be of 2 or 3 dimensions, .* 'float32'"),
            (_note(labels={"dtype": "uint8", "shape": [99]}), r"labels must be of 2 or 3 dimensions, .* of \[99\]"),
            (_note(labels={"dtype": "uint8", "shape": [9, -11]}), "sides of labels must be in"),
            (_note(labels={"dtype": "uint8", "shape": [9, 12]}), "labels must be a zlib stream of 108 bytes; got 99"),
            (_note(labels={"dtype": "uint8", "shape": [9, 10]}), "labels must be a zlib stream of 90 bytes; got 91"),
            (_note(labels={"dtype": "uint8", "shape": [3, 3, 11]}), "regions must have the size"),
            (_note(notes={"a": 1}), "metadata must map str to str; got 'a': 1"),
            (
                lambda header: header.update(blobs=header.pop("means")),
                r"missing: \['means'\], unknown: \['blobs'\]",
            ),
            (
                lambda header: header.update(extra=header.pop("labels")),
                r"missing: \[\], unknown: \['extra'\]",
            ),
            (_entry("means", dtype="I32"), "means must have a dtype"),
            (_entry("means", dtype="F16", shape=[13, 4]), "means must have a dtype"),
            (_entry("labels", dtype="I8"), "labels must have a dtype"),
            (_entry("region_ids", dtype="BOOL"), "region_ids must have a dtype"),
            (_entry("means", shape=[26]), "means must have 2 or 3 dimensions"),
            (_entry("means", shape=[2, 13]), "must have shape"),
            (_entry("cholesky", shape=[13, 3, 1]), "cholesky must have shape"),
            (_entry("colors", shape=[39, 1]), "colors must have shape"),
            (_entry("opacities", shape=[13, 1]), "opacities must have shape"),
            (_entry("region_ids", shape=[1, 13]), "region_ids must have shape"),
            (_entry("means", shape=[13, 3]), "while deserializing"),
            (_entry("means", data_offsets=[0, 10**12]), "while deserializing"),
        ],
    )
    def test_header(self, saved: Path, edit: Callable[[dict[str, Any]], None], message: str) -> None:
        header, body = read_header(saved)
        write_header(saved, header, body)
        load(saved)
        edit(header)
        write_header(saved, header, body)
        with pytest.raises(ValueError, match=rf"^cannot load {saved}: .*{message}") as caught:
            load(saved)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("means", float("nan"), "means must be finite"),
            ("colors", float("inf"), "colors must be finite"),
            ("opacities", float("nan"), "opacities must be finite"),
            ("cholesky", 0.0, "cholesky must have l11 > 0 and l22 > 0"),
            ("cholesky", -1.0, "cholesky must have l11 > 0 and l22 > 0"),
        ],
    )
    def test_values(self, saved: Path, name: str, value: float, message: str) -> None:
        header, body = read_header(saved)
        at = header[name]["data_offsets"][0]
        write_header(saved, header, body[:at] + struct.pack("<f", value) + body[at + 4 :])
        with pytest.raises(ValueError, match=message):
            load(saved)

    def test_negative_ids(self, path: Path) -> None:
        save(path, Scene(make_field(highest=70000), labels_with(70000)))
        header, body = read_header(path)
        at = header["region_ids"]["data_offsets"][0]
        write_header(path, header, body[:at] + struct.pack("<i", -1) + body[at + 4 :])
        with pytest.raises(ValueError, match="region_ids must .*non-negative"):
            load(path)

    def test_labels_that_are_no_stream(self, saved: Path) -> None:
        header, body = read_header(saved)
        at = header["labels"]["data_offsets"][0]
        write_header(saved, header, body[:at] + b"\0" + body[at + 1 :])
        with pytest.raises(ValueError, match="labels must be a zlib stream; Error"):
            load(saved)

    def test_damage_either_loads_or_raises_value_error(self, saved: Path, path: Path) -> None:
        content = saved.read_bytes()
        header_end = 8 + struct.unpack("<Q", content[:8])[0]
        rng = random.Random(0)
        refused: dict[str, list[str]] = {"cut": [], "header": [], "body": []}
        for turn in range(300):
            kind = ("cut", "header", "body")[turn % 3]
            damaged = bytearray(content)
            if kind == "cut":
                del damaged[rng.randrange(len(content)) :]
            else:
                span = (0, header_end) if kind == "header" else (header_end, len(content))
                for _ in range(rng.choice([1, 1, 2, 8])):
                    damaged[rng.randrange(*span)] ^= rng.randrange(1, 256)
            path.write_bytes(damaged)
            try:
                load(path)
            except ValueError as error:
                refused[kind].append(str(error))
        assert len(refused["cut"]) == 100
        assert len(refused["header"]) > 80
        assert 0 < len(refused["body"]) < 100
        messages = [message for group in refused.values() for message in group]
        assert all(message.startswith(f"cannot load {path}: ") for message in messages)
