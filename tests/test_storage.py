"""Scenes on disk: exact, deterministic, whole, and refused when damaged."""

import json
import random
import struct
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
WIDTHS = {(0, 1): 1 / 3, (2, 1): 1.25, (3, 7): 0.0}
TENSORS = ("means", "cholesky", "colors", "region_ids", "opacities")
Edit = Callable[[dict[str, Any]], None]


def make_labels(highest: int = 7, size: tuple[int, int] = SIZE) -> Tensor:
    labels = torch.arange(size[0] * size[1]).reshape(size) // 20
    labels[labels == labels.max()] = highest
    return labels


def make_field(
    highest: int = 7, opacities: bool = True, dtype: torch.dtype = torch.float32, channels: int = 3
) -> GaussianField:
    generator = torch.Generator().manual_seed(0)
    field = GaussianField.random(13, SIZE, channels=channels, seed=1, dtype=dtype)
    ids = torch.randint(0, 4, (13,), generator=generator)
    ids[3] = highest
    alpha = torch.rand(13, generator=generator, dtype=dtype) if opacities else None
    return GaussianField(field.means, field.cholesky, field.colors, ids, alpha, size=SIZE)


def make_batch() -> GaussianField:
    other = make_field()
    with torch.no_grad():
        other.means += 1.5
    return GaussianField.stack([make_field(), other])


def make_extreme_field(dtype: torch.dtype) -> GaussianField:
    field = make_field(dtype=dtype)
    with torch.no_grad():
        field.colors[0, 0], field.colors[0, 1] = -0.0, torch.finfo(dtype).smallest_normal / 2
    return field


def make_strided_field() -> GaussianField:
    """Make a field whose tensors are strided views of one storage."""
    parts = [torch.nn.Parameter(part) for part in (torch.rand(6, 8) + 0.5).split([2, 3, 3], dim=1)]
    field = GaussianField(*parts, size=SIZE)
    assert not any(parameter.is_contiguous() for parameter in field.parameters())
    return field


def tensors_of(scene: Scene) -> dict[str, Tensor | None]:
    labels = None if scene.regions is None else scene.regions.labels
    return {"labels": labels, **{name: getattr(scene.field, name) for name in TENSORS}}


def assert_same_scene(scene: Scene, expected: Scene) -> None:
    """Compare bit for bit."""
    for (name, tensor), other in zip(tensors_of(scene).items(), tensors_of(expected).values(), strict=True):
        if tensor is None or other is None:
            assert tensor is other, name
        else:
            assert tensor.dtype == other.dtype and tensor.shape == other.shape, name
            assert torch.equal(*(t.detach().contiguous().view(torch.uint8) for t in (tensor, other))), name
    softness, other_softness = (s.regions and s.regions.softness for s in (scene, expected))
    assert softness == other_softness and type(softness) is type(other_softness)
    assert (scene.size, scene.metadata) == (expected.size, expected.metadata)


def read_header(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    end = 8 + struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8:end]), content[end:]


def read_notes(path: Path) -> Any:
    (notes,) = read_header(path)[0]["__metadata__"].values()
    return json.loads(notes)


def write_header(path: Path, header: dict[str, Any], body: bytes) -> None:
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.safetensors"


@pytest.fixture
def saved(path: Path) -> Path:
    save(path, Scene(make_field(), RegionMap(make_labels(), 0.75), metadata={"title": "a"}))
    return path


SCENES: dict[str, Callable[[], Scene]] = {
    "float32": lambda: Scene(make_extreme_field(torch.float32), make_labels()),
    "float64": lambda: Scene(make_extreme_field(torch.float64), make_labels()),
    "soft": lambda: Scene(make_field(opacities=False), RegionMap(make_labels(), 1 / 3)),
    "widths of pairs": lambda: Scene(make_field(), RegionMap(make_labels(), WIDTHS)),
    "batch of one map": lambda: Scene(make_field(), RegionMap(make_labels()[None], WIDTHS)),
    "grey without a map": lambda: Scene(make_field(channels=1)),
    "without region ids": lambda: Scene(GaussianField.random(5, SIZE, channels=4, seed=0)),
    "batch": lambda: Scene(make_batch(), make_labels()),
    "batch of maps": lambda: Scene(make_batch(), torch.stack([make_labels(), make_labels().flip(0)])),
    "no Gaussians": lambda: Scene(make_field().subset(torch.zeros(13, dtype=torch.bool)), make_labels()),
    "strided views": lambda: Scene(make_strided_field()),
    "metadata": lambda: Scene(make_field(), make_labels(), {"ü\n\"'\\": "\0 é 🖼", "format": "mine", "": ""}),
}


class TestSave:
    @pytest.mark.parametrize("name", SCENES)
    def test_round_trip(self, path: Path, name: str) -> None:
        scene = SCENES[name]()
        assert save(path, scene) == path.stat().st_size
        loaded = load(path)
        path.write_bytes(bytes(path.stat().st_size))  # the scene does not depend on the file
        assert_same_scene(loaded, scene)
        if scene.regions is not None or scene.field.region_ids is None:
            image = loaded()
            assert torch.equal(image, scene())
            image.sum().backward()
            assert loaded.field.colors.grad is not None

    @pytest.mark.parametrize(
        ("highest", "dtype"),
        [(255, "U8"), (256, "U16"), (65535, "U16"), (65536, "I32"), (2**31 - 1, "I32"), (2**31, "I64"), (2**62, "I64")],
    )
    def test_smallest_integers(self, path: Path, highest: int, dtype: str) -> None:
        scene = Scene(make_field(highest), make_labels(highest))
        save(path, scene)
        assert read_header(path)[0]["region_ids"]["dtype"] == dtype
        assert read_notes(path)["labels"]["dtype"] == dtype.replace("U", "uint").replace("I", "int")
        assert_same_scene(load(path), scene)

    def test_format(self, saved: Path) -> None:
        with safetensors.safe_open(saved, framework="numpy") as file:
            assert sorted(file.keys()) == ["cholesky", "colors", "labels", "means", "opacities", "region_ids"]
            notes = {name: json.loads(text) for name, text in file.metadata().items()}
            assert 0 <= notes[FORMAT].pop("checksum") < 1 << 32
            assert notes == {
                FORMAT: {
                    "version": 1,
                    "kcgs_version": kcgs.__version__,
                    "size": [9, 11],
                    "softness": 0.75,
                    "labels": {"dtype": "uint8", "shape": [9, 11]},
                    "notes": {"title": "a"},
                }
            }

    @pytest.mark.parametrize("highest", [7, 1 << 40])
    def test_maps_are_small(self, path: Path, highest: int) -> None:
        labels = make_labels(highest, (45, 55))
        assert save(path, Scene(GaussianField.random(5, (45, 55), seed=0), labels)) < 5 * 32 + 1_200

    def test_same_scene_same_bytes(self, path: Path) -> None:
        """In any order of the metadata."""
        contents = set()
        for names in ("qwertyuiop", "poiuytrewq", "qwertyuiop"):
            save(path, Scene(make_field(), make_labels(), metadata={name: name for name in names}))
            contents.add(path.read_bytes())
        assert len(contents) == 1

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("means", float("nan"), "means must be finite"),
            ("colors", float("inf"), "colors must be finite"),
            ("cholesky", 0.0, "cholesky must have l11 > 0"),
        ],
    )
    def test_bad_values(self, saved: Path, name: str, value: float, message: str) -> None:
        """Values that `load` would refuse; an existing file stays."""
        before, field = saved.read_bytes(), make_field()
        with torch.no_grad():
            getattr(field, name)[2] = value
        with pytest.raises(ValueError, match=message):
            save(saved, Scene(field))
        assert saved.read_bytes() == before and list(saved.parent.iterdir()) == [saved]

    def test_bad_arguments(self, path: Path) -> None:
        with pytest.raises(ValueError, match=r"width must be in \[1, 1048576\]; got 1048577"):
            save(path, Scene(GaussianField.random(3, (4, MAX_SIDE + 1), seed=0)))
        with pytest.raises(TypeError, match="scene must be a Scene; got GaussianField"):
            save(path, make_field())  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=r"path must end in \.safetensors or \.kcgs; got"):
            save(path.with_suffix(".pt"), Scene(make_field()))
        with pytest.raises(FileNotFoundError, match="nowhere"):
            save(path.parent / "nowhere" / path.name, Scene(make_field()))
        assert list(path.parent.iterdir()) == []


def change_notes(**changes: Any) -> Edit:
    """Change entries of the JSON object; None: leave it out."""

    def edit(header: dict[str, Any]) -> None:
        notes = json.loads(header["__metadata__"][FORMAT]) | changes
        present = {name: value for name, value in notes.items() if value is not None}
        header["__metadata__"][FORMAT] = json.dumps(present)

    return edit


def change_labels(dtype: str, *shape: int) -> Edit:
    return change_notes(labels={"dtype": dtype, "shape": shape})


def replace_notes(text: str) -> Edit:
    return lambda header: header["__metadata__"].update({FORMAT: text})


def change_tensor(name: str, **changes: Any) -> Edit:
    return lambda header: header[name].update(changes)


def rename_tensor(old: str, new: str) -> Edit:
    return lambda header: header.update({new: header.pop(old)})


class TestLoad:
    @pytest.mark.parametrize(
        ("edit", "message"),
        [
            (lambda header: header.update(__metadata__={"format": "pt"}), r"an entry 'kcgs\.scene'; got \['format'\]"),
            (replace_notes("{"), "Expecting property name"),
            (replace_notes("[" * 100_000), "recursion"),
            (change_notes(version=2), "its version must be 1; got 2"),
            (change_notes(size=None), "its 'kcgs.scene' must have an entry 'size'"),
            (change_notes(checksum=7), "its checksum is wrong: the file is damaged, or was edited"),
            (change_notes(size=[0, 11]), r"height must be in \[1, 1048576\]; got 0"),
            (change_notes(size=[9, 1 << 21]), r"width must be in \[1, 1048576\]; got 2097152"),
            (change_notes(softness="wide"), "softness must be"),
            (change_notes(softness=[[[0], 1, 0.5]]), "unhashable"),
            (change_notes(softness=[[0, 99, 0.5]]), r"pairs of two different ids in the map; got \(0, 99\)"),
            (change_notes(labels={"shape": [9, 11]}), "missing 1 required positional argument: 'dtype'"),
            (change_labels("float32", 9, 11), "labels must be of 2 or 3 dimensions, .* 'float32'"),
            (change_labels("uint8", 99), r"labels must be of 2 or 3 dimensions, .* of \[99\]"),
            (change_labels("uint8", 9, -11), "sides of labels must be in"),
            (change_labels("uint8", 9, 10), "labels must be a zlib stream of 90 bytes; got 91"),
            (change_labels("uint8", 3, 3, 11), "regions must have the size"),
            (change_notes(notes={"a": 1}), "metadata must map str to str; got 'a': 1"),
            (rename_tensor("means", "blobs"), r"missing: \['means'\], unknown: \['blobs'\]"),
            (change_tensor("means", dtype="I32"), "means must have a dtype"),
            (change_tensor("labels", dtype="I8"), "labels must have a dtype"),
            (change_tensor("means", shape=[26]), "means must have 2 or 3 dimensions"),
            (change_tensor("colors", shape=[39, 1]), "colors must have shape"),
            (change_tensor("means", data_offsets=[0, 10**12]), "while deserializing"),
        ],
    )
    def test_bad_header(self, saved: Path, edit: Edit, message: str) -> None:
        header, body = read_header(saved)
        change_notes(checksum=None)(header)
        edit(header)
        write_header(saved, header, body)
        with pytest.raises(ValueError, match=rf"^cannot load {saved}: .*{message}") as caught:
            load(saved)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("cholesky", struct.pack("<f", 0.0), "cholesky must have l11 > 0 and l22 > 0"),
            ("labels", b"\0", "labels must be a zlib stream; Error"),
        ],
    )
    def test_bad_values(self, saved: Path, name: str, value: bytes, message: str) -> None:
        header, body = read_header(saved)
        change_notes(checksum=None)(header)
        start = header[name]["data_offsets"][0]
        write_header(saved, header, body[:start] + value + body[start + len(value) :])
        with pytest.raises(ValueError, match=message):
            load(saved)

    @pytest.mark.parametrize("content", [b"", b"\xff" * 64])
    def test_foreign_files(self, path: Path, content: bytes) -> None:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"^cannot load {path}: "):
            load(path)

    def test_bad_paths(self, tmp_path: Path, path: Path) -> None:
        for name in ("absent.safetensors", "absent.kcgs"):
            with pytest.raises(FileNotFoundError, match=f"^no such file: .*{name}$"):
                load(tmp_path / name)
        with pytest.raises(ValueError, match=r"path must end in \.safetensors or \.kcgs; got"):
            load(tmp_path)
        safetensors.torch.save_file({"means": torch.rand(3, 2)}, path)
        with pytest.raises(ValueError, match=r"its metadata must have an entry 'kcgs\.scene'; got \[\]"):
            load(path)

    def test_damage_raises_value_error_or_changes_nothing(self, saved: Path, path: Path) -> None:
        content, scene, rng = saved.read_bytes(), load(saved), random.Random(0)
        messages = []
        for turn in range(150):
            damaged = bytearray(content)
            kind = ("cut", "bit", "bytes")[turn % 3]
            if kind == "cut":
                del damaged[rng.randrange(len(content)) :]
            elif kind == "bit":
                damaged[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
            else:
                for _ in range(rng.choice([1, 2, 8])):
                    damaged[rng.randrange(len(content))] ^= rng.randrange(1, 256)
            path.write_bytes(damaged)
            try:
                loaded = load(path)
            except ValueError as error:
                messages.append(str(error))
            else:
                assert_same_scene(loaded, scene)
        assert len(messages) > 140 and all(message.startswith(f"cannot load {path}: ") for message in messages)
