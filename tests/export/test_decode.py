"""export/decode.py: its images, its errors, alone where torch and kcgs are not there."""

from __future__ import annotations

import importlib.util
import json
import random
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import onnx
import pytest
import torch
from PIL import Image
from torch import Tensor

import kcgs
from kcgs import GaussianField, RegionMap, Scene
from kcgs.data import save_image
from kcgs.onnx import scene_decoder
from kcgs.onnx.graph import FLOAT, INT64, Graph, Value

ROOT = Path(kcgs.__file__).resolve().parent.parent
SCRIPT = ROOT / "export" / "decode.py"
if not SCRIPT.is_file():
    pytest.skip("not a source checkout: there is no export/decode.py", allow_module_level=True)

SIZE = (37, 53)
IDS = [5, 300, 70_000]


def load_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("kcgs_export_decode", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


SCRIPT_MODULE = load_script()


def make_labels() -> Tensor:
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    index = torch.where((x - 20) ** 2 + (y - 15) ** 2 < 80, 2, (x + 2 * y > 70).long())
    return torch.tensor(IDS)[index]


def make_field() -> GaussianField:
    field = GaussianField.random(60, SIZE, regions=make_labels(), seed=1)
    generator = torch.Generator().manual_seed(2)
    alpha = torch.rand(60, generator=generator)
    field = GaussianField(field.means, field.cholesky, field.colors, field.region_ids, alpha, size=SIZE)
    with torch.no_grad():
        field.cholesky[:, 1] = torch.randn(60, generator=generator)
        field.colors *= 1.5
    return field


def ramp_decoder(interactive: bool) -> onnx.ModelProto:
    """Stand-in for a scene decoder: red is x, green is y, blue the sum of `visible`, over 16."""
    g = Graph()
    size = g.input("size", INT64, [2])
    view = g.input("view", FLOAT, [4]) if interactive else g.constant(np.array([0, 0, 12, 10], np.float32))
    visible = g.input("visible", FLOAT, [2]) if interactive else g.constant(np.array([1, 2], np.float32))

    def along(axis: int) -> Value:
        side, low, high = g.Gather(size, axis), g.Gather(view, 1 - axis), g.Gather(view, 3 - axis)
        return (g.Range(0, side, 1).astype(FLOAT) + 0.5) * ((high - low) / side.astype(FLOAT)) + low

    planes = along(1), g.Unsqueeze(along(0), [1]), g.ReduceSum(visible, keepdims=0)
    image = g.Concat(*(g.Unsqueeze(g.Expand(plane, size), [0, 1]) for plane in planes), axis=1) / 16
    metadata = {"format": "kcgs.decoder", "format_version": "1", "kind": "scene", "region_ids": "[7, 9]"}
    return g.close(image, "image", [1, 3, "H", "W"], metadata=metadata | {"height": "10", "width": "12"})


def ramp(size: tuple[int, int], view: tuple[float, ...] = (0, 0, 12, 10), blue: float = 3) -> np.ndarray:
    x = view[0] + (np.arange(size[1]) + 0.5) * (view[2] - view[0]) / size[1]
    y = view[1] + (np.arange(size[0]) + 0.5) * (view[3] - view[1]) / size[0]
    return np.stack([np.broadcast_to(x, size), np.broadcast_to(y[:, None], size), np.full(size, blue)]) / 16


class Files(NamedTuple):
    plain: Path
    interactive: Path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("decoders")
    made = Files(folder / "plain.onnx", folder / "interactive.onnx")
    onnx.save(ramp_decoder(interactive=False), made.plain)
    onnx.save(ramp_decoder(interactive=True), made.interactive)
    return made


class Result(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def decode(capsys: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    """Run the command within this process."""

    def run(*arguments: object) -> Result:
        try:
            code = SCRIPT_MODULE.main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = stop.code
        return Result(code, *capsys.readouterr())

    return run


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image).astype(int)


def library_levels(folder: Path, field: GaussianField, regions: RegionMap | None, size: tuple[int, int]) -> np.ndarray:
    path = folder / "library.png"
    save_image(path, Scene(field, regions).render(size))
    return read(path)


class TestSceneDecoders:
    @pytest.mark.parametrize(
        ("name", "options", "size"),
        [
            ("plain", [], (10, 12)),
            ("interactive", ["--scale", 2.5], (25, 30)),
            ("interactive", ["--size", "7x1"], (1, 7)),
        ],
    )
    def test_sizes(
        self, files: Files, decode: Any, tmp_path: Path, name: str, options: list[object], size: tuple[int, int]
    ) -> None:
        output = tmp_path / "out.npy"
        assert decode(getattr(files, name), "-o", output, *options) == Result(0, "", "")
        np.testing.assert_allclose(np.load(output), ramp(size, blue=3 if name == "plain" else 2), rtol=1e-6)

    def test_view_and_regions(self, files: Files, decode: Any, tmp_path: Path) -> None:
        output = tmp_path / "out.npy"
        options = ["--view=-2,1.5,4,9", "--scale", 2, "--region", 9]
        assert decode(files.interactive, "-o", output, *options).code == 0
        np.testing.assert_allclose(np.load(output), ramp((15, 12), (-2, 1.5, 4, 9), blue=1), rtol=1e-5)

    def test_a_scene_of_the_library(self, decode: Any, tmp_path: Path) -> None:
        field, regions = make_field(), RegionMap(make_labels(), 0.7)
        decoder, output = tmp_path / "decoder.onnx", tmp_path / "out.png"
        onnx.save(scene_decoder(Scene(field, regions), clamp=False, interactive=True), decoder)
        assert decode(decoder, "-o", output, "--scale", 2) == Result(0, "", "")
        want = library_levels(tmp_path, field, regions, (74, 106))
        assert np.abs(read(output) - want).max() <= 1
        assert decode(decoder, "-o", output, "--scale", 2, "--view", "5,3,40,30").code == 0
        assert np.abs(read(output) - want[6:60, 10:80]).max() <= 1
        assert decode(decoder, "-o", output, "--region", *IDS).code == 0
        assert np.abs(read(output) - library_levels(tmp_path, field, regions, SIZE)).max() <= 1

    def test_times(self, files: Files, decode: Any, tmp_path: Path) -> None:
        output = tmp_path / "out.png"
        result = decode(files.plain, "-o", output, "--repeat", 3, "--threads", 1)
        assert re.fullmatch(r"loaded in [\d.]+ ms, decoded in [\d.]+ ms \(median of 3\)\n", result.out)
        result = decode(files.plain, "-o", output, "--repeat", 3, "--json", "--providers", "CPUExecutionProvider")
        report = json.loads(result.out)
        assert report["load_ms"] > 0 and report["decode_ms"] > 0
        del report["load_ms"], report["decode_ms"]
        assert report == {
            "output": str(output), "width": 12, "height": 10, "channels": 3, "repeat": 3,
            "providers": ["CPUExecutionProvider"], "bytes": files.plain.stat().st_size,
        }  # fmt: skip

    def test_replaces_what_was_there(self, files: Files, decode: Any, tmp_path: Path) -> None:
        output = tmp_path / "out.png"
        output.write_bytes(b"old")
        assert decode(files.plain, "-o", output).code == 0
        assert output.read_bytes().startswith(b"\x89PNG")
        assert list(tmp_path.iterdir()) == [output]


def _edit(**notes: str | None) -> Callable[[Any], None]:
    """Change the metadata of a model."""

    def change(model: onnx.ModelProto) -> None:
        kept = {entry.key: entry.value for entry in model.metadata_props} | notes
        onnx.helper.set_model_props(model, {key: value for key, value in kept.items() if value is not None})

    return change


def _rename_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].name = "shape"
    for node in model.graph.node:
        node.input[:] = ["shape" if name == "size" else name for name in node.input]


def _wrong_depth(model: onnx.ModelProto) -> None:
    axes = onnx.numpy_helper.from_array(np.array([0]), "axes")
    model.graph.initializer.append(axes)
    model.graph.node[-1].output[0] = "flat"
    model.graph.node.append(onnx.helper.make_node("Squeeze", ["flat", "axes"], ["image"]))
    del model.graph.output[0].type.tensor_type.shape.dim[0]


class TestRefusals:
    @pytest.fixture
    def refuses(self, decode: Any, tmp_path: Path) -> Callable[..., None]:
        """The command fails in one line that matches, and writes nothing."""

        def check(pattern: str, *arguments: object, code: int = 1, output: Path | None = None) -> None:
            folder = tmp_path / "output"
            folder.mkdir(exist_ok=True)
            result = decode(*arguments, "-o", output or folder / "out.png")
            assert result.code == code
            assert result.out == ""
            assert re.search(pattern, result.err), result.err
            assert result.err.startswith("decode.py: ") and result.err.count("\n") == 1
            assert list(folder.iterdir()) == []

        return check

    @pytest.mark.parametrize(
        ("arguments", "pattern"),
        [
            (["--scale", "0"], "argument --scale: must be a positive number; got '0'"),
            (["--scale", "two"], "--scale: must be a positive number; got 'two'"),
            (["--size", "640"], "--size: must be WxH, such as 640x480; got '640'"),
            (["--view", "0,0,5,nan"], "--view: must be LEFT,TOP,RIGHT,BOTTOM in pixels of the scene; got '0,0,5,nan'"),
            (["--view", "5,0,5,5"], "--view: must have LEFT < RIGHT and TOP < BOTTOM"),
            (["--view", "0,0,5,1e9"], "--view: must have LEFT < RIGHT and TOP < BOTTOM, up to 1048576"),
            (["--threads", "0"], "--threads: must be a whole number from 1 to 999999; got '0'"),
        ],
    )
    def test_usage(self, files: Files, refuses: Any, arguments: list[str], pattern: str) -> None:
        refuses(pattern, files.plain, *arguments, code=2)

    @pytest.mark.parametrize("options", [["--size", "0x3"], ["--scale", "1e300"]])
    def test_absurd_sizes(self, files: Files, refuses: Any, options: list[str]) -> None:
        refuses(r"the image must have 1 to 1048576 pixels a side; got \d+x\d+$", files.plain, *options)

    @pytest.mark.parametrize(
        ("error", "words", "code"), [(MemoryError, "not enough memory", 1), (KeyboardInterrupt, "nothing written", 130)]
    )
    def test_stopped(
        self,
        files: Files,
        refuses: Any,
        monkeypatch: pytest.MonkeyPatch,
        error: type[BaseException],
        words: str,
        code: int,
    ) -> None:
        def stop(*_: object) -> None:
            raise error

        monkeypatch.setattr(SCRIPT_MODULE, "encode_png", stop)
        refuses(words, files.plain, code=code)

    def test_outputs(self, files: Files, refuses: Any, tmp_path: Path) -> None:
        refuses(r"-o must end in .png or .npy; got .*out.jpg", files.plain, output=tmp_path / "out.jpg")
        nowhere = tmp_path / "nowhere" / "out.png"
        refuses(f"cannot write {nowhere}: the folder .*nowhere does not exist", files.plain, output=nowhere)
        folder = tmp_path / "folder.png"
        folder.mkdir()
        refuses(f"cannot write {folder}: it is a folder", files.plain, output=folder)

    def test_providers(self, files: Files, refuses: Any) -> None:
        pattern = "--providers: NoProvider not available here; there are .*CPUExecutionProvider"
        refuses(pattern, files.plain, "--providers", "NoProvider,CPUExecutionProvider")

    def test_a_provider_that_does_not_start(self, files: Files, refuses: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        runtime = SCRIPT_MODULE.onnxruntime
        begin = runtime.InferenceSession
        monkeypatch.setattr(runtime, "get_available_providers", lambda: ["SleepyProvider"])
        refuses("onnxruntime cannot load .*SleepyProvider", files.plain, "--providers", "SleepyProvider")
        # as onnxruntime does with some providers: it goes on without
        monkeypatch.setattr(
            runtime, "InferenceSession", lambda content, *_, **__: begin(content, providers=["CPUExecutionProvider"])
        )
        pattern = r"--providers: SleepyProvider did not start here; what did: \['CPUExecutionProvider'\]"
        refuses(pattern, files.plain, "--providers", "SleepyProvider")

    def test_what_a_decoder_does_not_take(self, files: Files, refuses: Any) -> None:
        refuses("--view needs an interactive decoder, with the input view", files.plain, "--view", "0,0,5,5")
        refuses("--region needs an interactive decoder, with the input visible", files.plain, "--region", 7)
        refuses(r"--region must be among the scene's regions \[7, 9\]; got 8", files.interactive, "--region", 8)

    def test_missing_files_and_folders(self, files: Files, refuses: Any, tmp_path: Path) -> None:
        refuses(r"cannot read .*absent.onnx: No such file or directory", tmp_path / "absent.onnx")
        refuses(r"cannot read .*: Is a directory", tmp_path)

    @pytest.mark.parametrize("text", [b"kcgs.decoder", b"visible"])
    def test_damaged_texts(self, files: Files, refuses: Any, tmp_path: Path, text: bytes) -> None:
        content, path = files.interactive.read_bytes(), tmp_path / "damaged.onnx"
        assert text in content
        path.write_bytes(content.replace(text, b"\xff" * len(text)))
        refuses(f"(onnxruntime cannot load {path}: |{path} is damaged: .* invalid start byte)", path)

    def test_truncated_decoders(self, files: Files, refuses: Any, tmp_path: Path) -> None:
        content = files.interactive.read_bytes()
        rng = random.Random(0)
        path = tmp_path / "cut.onnx"
        for _ in range(12):
            path.write_bytes(content[: rng.randrange(len(content))])
            refuses(f"(onnxruntime cannot load {path}: |{path} is not a decoder: )", path)

    @pytest.mark.parametrize(
        ("edit", "pattern"),
        [
            (_edit(format=None), "is not a decoder: format must be kcgs.decoder; got None"),
            (_edit(format_version="2"), "is not a decoder: format_version must be 1; got '2'"),
            (_edit(width="1e3"), "its width must be a whole number of 1 to 1048576 pixels; got '1e3'"),
            (_edit(region_ids='{"a": 1}'), "is damaged: its region_ids must be a JSON list of integers"),
            (_edit(region_ids="[7, 9, 11]"), "failed at 12x10: .*visible"),
            (_rename_input, "is not a decoder: its inputs must be .*; got"),
            (_wrong_depth, r"must give an image of shape \(1, C, 10, 12\); got \(3, 10, 12\)"),
        ],
    )
    def test_wrong_decoders(
        self, files: Files, refuses: Any, tmp_path: Path, edit: Callable[[Any], None], pattern: str
    ) -> None:
        model = onnx.load(files.interactive)
        edit(model)
        path = tmp_path / "wrong.onnx"
        path.write_bytes(model.SerializeToString())
        refuses(pattern, path)


# the script runs as a program in a process where no package but numpy and onnxruntime is there
_BLOCKED = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"torch", "kcgs", "onnx", "onnx_ir", "safetensors", "PIL", "scipy", "kornia"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import runpy
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


class TestAlone:
    def test_without_torch_and_kcgs(self, files: Files, tmp_path: Path) -> None:
        output = tmp_path / "out.png"
        command = [sys.executable, "-I", "-W", "error", "-c", _BLOCKED, str(SCRIPT), str(files.interactive)]
        result = subprocess.run(
            [*command, "-o", str(output), "--repeat", "2", "--json"], capture_output=True, text=True
        )
        assert (result.returncode, result.stderr) == (0, "")
        assert json.loads(result.stdout)["channels"] == 3 and output.is_file()

    def test_says_what_to_install(self) -> None:
        blocked = _BLOCKED.replace('"torch"', '"onnxruntime"')
        result = subprocess.run([sys.executable, "-I", "-c", blocked, SCRIPT], capture_output=True, text=True)
        assert result.returncode == 1
        assert result.stderr.strip().endswith("install what it needs: pip install numpy onnxruntime")
        assert "Traceback" not in result.stderr

    def test_states_its_dependencies(self) -> None:
        block = re.search(r"(?m)^# /// script\n((?:# .*\n)+)# ///$", SCRIPT.read_text())
        assert block is not None
        assert 'dependencies = ["numpy>=' in block[1] and '"onnxruntime>=' in block[1]
        assert 'requires-python = ">=3.11"' in block[1]
