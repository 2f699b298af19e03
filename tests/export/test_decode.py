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
from PIL import Image

import kcgs
from kcgs import GaussianField, Scene
from kcgs.onnx import generic_decoder, scene_decoder

ROOT = Path(kcgs.__file__).resolve().parent.parent
SCRIPT = ROOT / "export" / "decode.py"
if not SCRIPT.is_file():
    pytest.skip("not a source checkout: there is no export/decode.py", allow_module_level=True)

# an interactive decoder of a scene with the regions 0, 1 and 7, and images of it
SOFT = ROOT / "export" / "golden" / "soft.onnx"


def load_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("kcgs_export_decode", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


SCRIPT_MODULE = load_script()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A decoder of the whole scene alone."""
    path = tmp_path_factory.mktemp("decoders") / "plain.onnx"
    onnx.save(scene_decoder(Scene(GaussianField.random(200, (10, 12), seed=0)), clamp=False), path)
    return path


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


class TestImages:
    @pytest.mark.parametrize(
        ("options", "name"),
        [
            ([], "image_20x34"),
            (["--size", "41x24"], "image_24x41"),
            (["--view", "15.25,10.5,19.75,14", "--scale", 4], "image_view"),
            (["--region", 0, 1], "image_visible"),
        ],
    )
    def test_interactive(self, decode: Any, tmp_path: Path, options: list[object], name: str) -> None:
        assert decode(SOFT, "-o", tmp_path / "out.npy", *options) == Result(0, "", "")
        with np.load(SOFT.with_suffix(".npz")) as case:
            np.testing.assert_allclose(np.load(tmp_path / "out.npy"), case[name], rtol=0, atol=1e-3)

    def test_plain(self, plain: Path, decode: Any, tmp_path: Path) -> None:
        outputs = [tmp_path / "out.npy", tmp_path / "out.png"]
        for output in outputs:
            assert decode(plain, "-o", output, "--scale", 2.5) == Result(0, "", "")
        values = np.load(outputs[0])
        with Image.open(outputs[1]) as image:
            levels = np.asarray(image).transpose(2, 0, 1)
        assert values.shape == (3, 25, 30) and values.max() > 1
        np.testing.assert_allclose(levels, 255 * values.clip(0, 1), rtol=0, atol=0.51)

    def test_times(self, plain: Path, decode: Any, tmp_path: Path) -> None:
        output = tmp_path / "out.png"
        result = decode(plain, "-o", output, "--repeat", 3, "--threads", 1)
        assert re.fullmatch(r"loaded in [\d.]+ ms, decoded in [\d.]+ ms \(median of 3\)\n", result.out)
        result = decode(plain, "-o", output, "--repeat", 3, "--json", "--providers", "CPUExecutionProvider")
        report = json.loads(result.out)
        assert report["load_ms"] > 0 and report["decode_ms"] > 0
        del report["load_ms"], report["decode_ms"]
        assert report == {
            "output": str(output), "width": 12, "height": 10, "channels": 3, "repeat": 3,
            "providers": ["CPUExecutionProvider"], "bytes": plain.stat().st_size,
        }  # fmt: skip

    def test_replaces_what_was_there(self, plain: Path, decode: Any, tmp_path: Path) -> None:
        output = tmp_path / "out.png"
        output.write_bytes(b"old")
        assert decode(plain, "-o", output).code == 0
        assert output.read_bytes().startswith(b"\x89PNG")
        assert list(tmp_path.iterdir()) == [output]


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
    def test_usage(self, plain: Path, refuses: Any, arguments: list[str], pattern: str) -> None:
        refuses(pattern, plain, *arguments, code=2)

    @pytest.mark.parametrize("options", [["--size", "0x3"], ["--scale", "1e300"]])
    def test_absurd_sizes(self, plain: Path, refuses: Any, options: list[str]) -> None:
        refuses(r"the image must have 1 to 1048576 pixels a side; got \d+x\d+$", plain, *options)

    def test_stopped(self, plain: Path, refuses: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        errors = iter([MemoryError, KeyboardInterrupt])

        def stop(*_: object) -> None:
            raise next(errors)

        monkeypatch.setattr(SCRIPT_MODULE, "encode_png", stop)
        refuses("not enough memory for this image", plain)
        refuses("interrupted, nothing written", plain, code=130)

    def test_outputs(self, plain: Path, refuses: Any, tmp_path: Path) -> None:
        refuses(r"-o must end in .png or .npy; got .*out.jpg", plain, output=tmp_path / "out.jpg")
        nowhere = tmp_path / "nowhere" / "out.png"
        refuses(f"cannot write {nowhere}: the folder .*nowhere does not exist", plain, output=nowhere)
        folder = tmp_path / "folder.png"
        folder.mkdir()
        refuses(f"cannot write {folder}: it is a folder", plain, output=folder)

    def test_providers(self, plain: Path, refuses: Any) -> None:
        pattern = "--providers: NoProvider not available here; there are .*CPUExecutionProvider"
        refuses(pattern, plain, "--providers", "NoProvider,CPUExecutionProvider")

    def test_a_provider_that_does_not_start(self, plain: Path, refuses: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        """As some do not: onnxruntime goes on without."""
        runtime = SCRIPT_MODULE.onnxruntime
        begin = runtime.InferenceSession
        monkeypatch.setattr(runtime, "get_available_providers", lambda: ["SleepyProvider"])
        monkeypatch.setattr(
            runtime, "InferenceSession", lambda content, *_, **__: begin(content, providers=["CPUExecutionProvider"])
        )
        pattern = r"--providers: SleepyProvider did not start here; what did: \['CPUExecutionProvider'\]"
        refuses(pattern, plain, "--providers", "SleepyProvider")

    def test_what_a_decoder_does_not_take(self, plain: Path, refuses: Any) -> None:
        refuses("--view needs an interactive decoder, with the input view", plain, "--view", "0,0,5,5")
        refuses("--region needs an interactive decoder, with the input visible", plain, "--region", 7)
        refuses(r"--region must be among the scene's regions \[0, 1, 7\]; got 8", SOFT, "--region", 8)

    def test_missing_files_and_folders(self, refuses: Any, tmp_path: Path) -> None:
        refuses(r"cannot read .*absent.onnx: No such file or directory", tmp_path / "absent.onnx")
        refuses(r"cannot read .*: Is a directory", tmp_path)

    @pytest.mark.parametrize("text", [b"kcgs.decoder", b"visible"])
    def test_damaged_texts(self, refuses: Any, tmp_path: Path, text: bytes) -> None:
        content, path = SOFT.read_bytes(), tmp_path / "damaged.onnx"
        assert text in content
        path.write_bytes(content.replace(text, b"\xff" * len(text)))
        refuses(f"(onnxruntime cannot load {path}: |{path} is damaged: .* invalid start byte)", path)

    def test_truncated_decoders(self, refuses: Any, tmp_path: Path) -> None:
        content = SOFT.read_bytes()
        rng = random.Random(0)
        path = tmp_path / "cut.onnx"
        for _ in range(12):
            path.write_bytes(content[: rng.randrange(len(content))])
            refuses(f"(onnxruntime cannot load {path}: |{path} is not a decoder: )", path)

    @pytest.mark.parametrize(
        ("change", "pattern"),
        [
            ({"format": "kcgs"}, "is not a decoder: format must be kcgs.decoder; got 'kcgs'"),
            ({"format_version": "2"}, "is not a decoder: format_version must be 1; got '2'"),
            ({"width": "1e3"}, "its width must be a whole number of 1 to 1048576 pixels; got '1e3'"),
            ({"region_ids": '{"a": 1}'}, "is damaged: its region_ids must be a JSON list of integers"),
            ({"region_ids": "[7, 9]"}, "failed at 34x20: .*visible"),
        ],
    )
    def test_wrong_decoders(self, refuses: Any, tmp_path: Path, change: dict[str, str], pattern: str) -> None:
        model = onnx.load(SOFT)
        onnx.helper.set_model_props(model, {entry.key: entry.value for entry in model.metadata_props} | change)
        onnx.save(model, tmp_path / "wrong.onnx")
        refuses(pattern, tmp_path / "wrong.onnx")

    def test_a_generic_decoder(self, refuses: Any, tmp_path: Path) -> None:
        onnx.save(generic_decoder(), tmp_path / "generic.onnx")
        refuses("is not a decoder: its inputs must be .*; got", tmp_path / "generic.onnx")


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
    def test_without_torch_and_kcgs(self, tmp_path: Path) -> None:
        output = tmp_path / "out.png"
        command = [sys.executable, "-I", "-W", "error", "-c", _BLOCKED, str(SCRIPT), str(SOFT)]
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
