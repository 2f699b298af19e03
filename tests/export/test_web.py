"""The page that draws decoders, in headless Chromium, against onnxruntime in Python.

The decoders are made here, node by node, and not by the exporter: any graph that keeps the contract must open.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from .browser import WEB, Browser, array, build, npm, serving

LEVEL = 1 / 255
WIDTH, HEIGHT = 96, 64
REGIONS = [0, 3, 7]  # three upright stripes


def make_decoder(path: Path, *, interactive: bool = True, kind: str = "scene", channels: int = 3) -> Path:
    """Write a decoder of waves over the scene, cut into stripes, that leave [0, 1] here and there."""
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def constant(name: str, value: Any, dtype: type = np.float32) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, dtype=dtype), name))
        return name

    def op(kind: str, *inputs: str, **attributes: Any) -> str:
        name = f"{kind}_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    constant("zero", 0, np.int64), constant("one", 1, np.int64), constant("half", 0.5)
    view = "view" if interactive else constant("whole", [0, 0, WIDTH, HEIGHT])

    def along(axis: int) -> str:
        """Scene coordinates of the output's pixel centres; axis 0 is x."""
        count = op("Gather", "size", constant(f"size_{axis}", 1 - axis, np.int64), axis=0)
        low = op("Gather", view, constant(f"low_{axis}", axis, np.int64), axis=0)
        high = op("Gather", view, constant(f"high_{axis}", axis + 2, np.int64), axis=0)
        steps = op("Add", op("Cast", op("Range", "zero", count, "one"), to=TensorProto.FLOAT), "half")
        step = op("Div", op("Sub", high, low), op("Cast", count, to=TensorProto.FLOAT))
        return op("Add", op("Mul", steps, step), low)

    constant("column", [1, 1, 1, -1], np.int64), constant("row", [1, 1, -1, 1], np.int64)
    xs, ys = op("Reshape", along(0), "column"), op("Reshape", along(1), "row")
    planes = (1, channels, 1, 1)
    across = op("Sin", op("Mul", xs, constant("fx", np.linspace(0.11, 0.23, channels).reshape(planes))))
    down = op("Cos", op("Mul", ys, constant("fy", np.linspace(0.19, 0.13, channels).reshape(planes))))
    waves = op("Add", op("Mul", op("Mul", across, down), constant("height", 0.6)), "half")
    # Contours off the pixel grid, where rounding cannot decide.
    contours = np.reshape([-1e9, 0.3137 * WIDTH, 0.7071 * WIDTH, 1e9], (1, -1, 1, 1))
    after = op("Less", constant("starts", contours[:, :-1]), xs)
    before = op("Less", xs, constant("ends", contours[:, 1:]))
    stripes = op("Cast", op("And", after, before), to=TensorProto.FLOAT)
    if interactive:
        factors = op("Reshape", "visible", constant("stripes", [1, len(REGIONS), 1, 1], np.int64))
        stripes = op("Mul", stripes, factors)
    mask = op("ReduceSum", stripes, constant("axes", [1], np.int64), keepdims=1)
    nodes.append(helper.make_node("Mul", [waves, mask], ["image"]))

    inputs = [helper.make_tensor_value_info("size", TensorProto.INT64, [2])]
    if interactive:
        inputs += [helper.make_tensor_value_info("view", TensorProto.FLOAT, [4])]
        inputs += [helper.make_tensor_value_info("visible", TensorProto.FLOAT, [len(REGIONS)])]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, channels, "H", "W"])
    graph = helper.make_graph(nodes, "waves", inputs, [image], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    properties: dict[str, Any] = {
        "format": "kcgs.decoder",
        "format_version": 1,
        "kind": kind,
        "kcgs_version": "0.1.0",
        "recipe": "",
        "height": HEIGHT,
        "width": WIDTH,
        "channels": channels,
        "num_gaussians": 1234,
        "num_regions": len(REGIONS),
        "region_ids": json.dumps(REGIONS),
        "contours": "hard",
        "cutoff": 0.001,
        "precision": "fp32",
        "clamp": "false",
        "left_out": json.dumps(["no soft weights: the contours are hard"]),
    }
    helper.set_model_props(model, {key: str(value) for key, value in properties.items()})
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def decode(path: Path, size: tuple[int, int], **inputs: list[float]) -> NDArray[np.float32]:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    feeds = {name: np.asarray(value, dtype=np.float32) for name, value in inputs.items()}
    (image,) = session.run(["image"], {"size": np.asarray(size, dtype=np.int64), **feeds})
    return np.asarray(image, dtype=np.float32)


class Viewer(Browser):
    """The viewer's page; see export/web/test/drive.mjs."""

    def settle(self) -> None:
        self.evaluate("kcgs.settled()")

    def render(self, size: tuple[int, int], **inputs: list[float]) -> NDArray[np.float32]:
        request = json.dumps({"size": size, **inputs})
        return array(self.evaluate(f"kcgs.render({request}).then(({{data, dims}}) => ({{data, dims}}))"))

    def canvas(self) -> tuple[dict[str, Any], NDArray[np.float32]]:
        """Give the part of the scene that is on the canvas, and its pixels (1, 3, H, W) in [0, 1]."""
        self.settle()
        part = self.evaluate("kcgs.part")
        pixels = self.evaluate(
            "(() => { const {x, y, width, height} = kcgs.part;"
            "const image = document.querySelector('#picture').getContext('2d').getImageData(x, y, width, height);"
            "return {data: Float32Array.from(image.data), dims: [height, width, 4]}; })()"
        )
        return part, array(pixels)[None, ..., :3].transpose(0, 3, 1, 2) / 255

    def alert(self) -> str:
        return str(self.evaluate("document.querySelector('[role=alert]').textContent"))


@pytest.fixture(scope="module")
def site(node_modules: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """The built page in a folder of its own, and its address."""
    folder = tmp_path_factory.mktemp("site")
    build("build", "--", "--outDir", str(folder), "--emptyOutDir")
    shutil.rmtree(folder / "examples", ignore_errors=True)
    with serving(folder) as address:
        yield folder, address


@pytest.fixture(scope="module")
def browser(chromium: str, site: tuple[Path, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    driven = Viewer(chromium, tmp_path_factory.mktemp("browser") / "errors.txt")
    yield driven
    driven.close()


@pytest.fixture(scope="module")
def decoder(site: tuple[Path, str]) -> Path:
    return make_decoder(site[0] / "waves.onnx")


@pytest.fixture
def page(browser: Viewer, site: tuple[Path, str], decoder: Path) -> Iterator[Viewer]:
    """The page with the decoder open, at rest; nothing may have been asked of another server when a test ends."""
    browser.do("look", width=1000, height=700)
    start = f"{site[1]}?decoder=waves.onnx"
    if browser.evaluate("location.href") == start:
        browser.evaluate("kcgs.open('waves.onnx')")
    else:
        browser.do("goto", url=start)
    browser.settle()
    assert browser.alert() == ""
    yield browser
    addresses = browser.do("requests")
    assert addresses and all(address.startswith((site[1], "blob:" + site[1], "data:")) for address in addresses)
    assert [text for text in browser.do("problems") if "404" not in text] == []


def original_of(decoder: Path, path: Path) -> Path:
    image = decode(decoder, (HEIGHT, WIDTH), view=[0, 0, WIDTH, HEIGHT], visible=[1, 1, 1])[0]
    levels = (np.clip(image, 0, 1) * 255).round().astype(np.uint8).transpose(1, 2, 0)
    Image.fromarray((levels // 8 * 8).astype(np.uint8)).save(path)
    return path


class TestPicture:
    """What the browser decodes is what Python decodes."""

    @pytest.mark.parametrize(
        ("size", "view", "visible"),
        [
            ((HEIGHT, WIDTH), [0, 0, WIDTH, HEIGHT], [1, 1, 1]),
            ((2 * HEIGHT, 2 * WIDTH), [0, 0, WIDTH, HEIGHT], [1, 1, 1]),
            ((61, 83), [10.25, 5.5, 33.0, 20.75], [1, 1, 1]),
            ((HEIGHT, WIDTH), [0, 0, WIDTH, HEIGHT], [1, 0, 1]),
        ],
        ids=["native", "twice", "view", "hidden"],
    )
    def test_render(
        self, page: Viewer, decoder: Path, size: tuple[int, int], view: list[float], visible: list[float]
    ) -> None:
        want = decode(decoder, size, view=view, visible=visible)
        got = page.render(size, view=view, visible=visible)
        assert got.shape == want.shape == (1, 3, *size)
        assert want.std() > 0.1
        np.testing.assert_allclose(got, want, atol=LEVEL)

    @pytest.mark.parametrize("scale", ["fit", "native", "near"])
    def test_canvas(self, page: Viewer, decoder: Path, scale: str) -> None:
        if scale == "native":
            page.do("click", on="#native")
        elif scale == "near":
            for _ in range(8):
                page.do("press", key="+")
            page.do("press", key="ArrowRight", on="#picture")
        part, got = page.canvas()
        want = decode(decoder, (part["height"], part["width"]), view=part["rect"], visible=[1, 1, 1])
        if scale == "native":
            assert (part["width"], part["height"], part["rect"]) == (WIDTH, HEIGHT, [0, 0, WIDTH, HEIGHT])
        np.testing.assert_allclose(got, np.clip(want, 0, 1), atol=LEVEL)

    def test_hidden_region_on_the_canvas(self, page: Viewer, decoder: Path) -> None:
        assert page.do("text", on="#regions").split() == ["Region", "0", "Region", "3", "Region", "7"]
        page.do("click", on="#regions li:nth-child(2) input")
        part, got = page.canvas()
        want = decode(decoder, (part["height"], part["width"]), view=part["rect"], visible=[1, 0, 1])
        np.testing.assert_allclose(got, np.clip(want, 0, 1), atol=LEVEL)
        page.do("click", on="[data-show=none]")
        assert page.canvas()[1].max() == 0
        page.do("click", on="[data-show=all]")
        assert page.canvas()[1].max() > 0.9

    def test_wasm_where_webgpu_fails(self, page: Viewer, decoder: Path) -> None:
        """The browser of the tests has no GPU: choosing it anyway is a session that fails, said once."""
        page.evaluate(
            "(async () => { const select = document.querySelector('#provider'); select.options[0].disabled = false;"
            "select.value = 'webgpu'; select.dispatchEvent(new Event('change')); await kcgs.settled(); })()"
        )
        assert page.do("text", on="[role=status]").startswith("WebGPU could not run this decoder, so WASM draws it")
        part, got = page.canvas()
        want = decode(decoder, (part["height"], part["width"]), view=part["rect"], visible=[1, 1, 1])
        np.testing.assert_allclose(got, np.clip(want, 0, 1), atol=LEVEL)
        page.evaluate("document.querySelector('#provider').value = 'wasm'")

    def test_threads_where_the_page_is_isolated(self, page: Viewer, site: tuple[Path, str], decoder: Path) -> None:
        page.do("goto", url=f"{site[1]}isolated/?decoder=waves.onnx")
        assert page.evaluate("crossOriginIsolated") is True
        view = [0.0, 0.0, WIDTH, HEIGHT]
        want = decode(decoder, (HEIGHT, WIDTH), view=view, visible=[1, 1, 1])
        np.testing.assert_allclose(page.render((HEIGHT, WIDTH), view=view, visible=[1, 1, 1]), want, atol=LEVEL)

    @pytest.mark.parametrize("channels", [1, 3])
    def test_without_interaction(self, page: Viewer, tmp_path: Path, channels: int) -> None:
        path = make_decoder(tmp_path / "plain.onnx", interactive=False, channels=channels)
        page.do("files", on="#decoder-file", paths=[str(path)])
        page.do("wait", expression="document.title.startsWith('plain')")
        page.do("click", on="#native")
        part, got = page.canvas()
        assert part["rect"] == [0, 0, WIDTH, HEIGHT]
        want = decode(path, (HEIGHT, WIDTH))
        np.testing.assert_allclose(got, np.broadcast_to(np.clip(want, 0, 1), got.shape), atol=LEVEL)
        assert "--interactive" in page.do("text", on="#regions-section")
        assert "16 megapixels" in page.do("text", on="aside")


class TestRefusal:
    """A file that cannot be opened gives one message and changes nothing else."""

    @pytest.mark.parametrize(
        ("name", "says"),
        [
            ("empty", "empty"),
            ("text", "not an ONNX file"),
            ("truncated", "cut short"),
            ("headless", "cut short"),
            ("foreign", "not a kcgs decoder"),
            ("generic", "opens scene decoders"),
            ("version", "format version is 2"),
            ("damaged", "could not be loaded"),
        ],
    )
    def test_file(self, page: Viewer, decoder: Path, tmp_path: Path, name: str, says: str) -> None:
        before = page.canvas()[1]
        path = tmp_path / f"{name}.onnx"
        whole = decoder.read_bytes()
        contents = {"empty": b"", "text": b"A picture of a decoder.\n" * 40, "truncated": whole[: len(whole) // 2]}
        contents["headless"] = whole[:-1]
        contents["version"] = whole.replace(b"format_version\x12\x011", b"format_version\x12\x012")
        contents["damaged"] = whole.replace(b"ReduceSum", b"ReduceSux")
        if name == "generic":
            make_decoder(path, kind="generic")
        elif name == "foreign":
            model = onnx.load(decoder)
            del model.metadata_props[:]
            onnx.save(model, path)
        else:
            path.write_bytes(contents[name])
        page.do("files", on="#decoder-file", paths=[str(path)])
        page.do("wait", expression="document.querySelector('[role=alert]').textContent !== ''")
        assert page.alert().startswith(f"Could not open {name}.onnx: ") and says in page.alert()
        assert page.evaluate("[...document.querySelectorAll('[role=alert]')].length") == 1
        np.testing.assert_array_equal(page.canvas()[1], before)
        page.do("click", on="#dismiss")
        page.do("press", key="+")
        assert not np.array_equal(page.canvas()[1], before)

    def test_address_elsewhere(self, page: Viewer, site: tuple[Path, str]) -> None:
        page.do("goto", url=f"{site[1]}?decoder=http://example.invalid/a.onnx")
        assert "the server that this page came from" in page.alert()

    def test_address_missing(self, page: Viewer, site: tuple[Path, str]) -> None:
        page.do("goto", url=f"{site[1]}?decoder=nowhere.onnx")
        assert "404" in page.alert()
        assert page.evaluate("kcgs.metadata") is None

    def test_original_that_is_no_image(self, page: Viewer, tmp_path: Path) -> None:
        (tmp_path / "broken.png").write_bytes(b"no picture")
        page.do("files", on="#original-file", paths=[str(tmp_path / "broken.png")])
        page.do("wait", expression="document.querySelector('[role=alert]').textContent !== ''")
        assert "broken.png: it is no image" in page.alert()


class TestView:
    def test_keys(self, page: Viewer) -> None:
        start = page.evaluate("kcgs.scale")
        page.do("press", key="+")
        assert page.evaluate("kcgs.scale") == pytest.approx(start * 2**0.5)
        before = page.evaluate("kcgs.part.rect")
        page.do("press", key="ArrowRight", on="#picture")
        after = page.evaluate("kcgs.part.rect")
        assert after[0] > before[0] and after[2] > before[2] and after[1] == before[1]
        for _ in range(30):
            page.do("press", key="+")
        assert page.evaluate("kcgs.scale") == 200
        page.do("press", key="0")
        assert page.evaluate("kcgs.scale") == pytest.approx(start)
        page.do("press", key="-")
        assert page.evaluate("kcgs.scale") < start

    def test_wheel_keeps_the_point_under_the_pointer(self, page: Viewer) -> None:
        here = (
            "(() => { const {x, y, rect} = kcgs.part, s = kcgs.scale;"
            "return [rect[0] + (300 - x) / s, rect[1] + (250 - y) / s]; })()"
        )
        box = page.evaluate("document.querySelector('#picture').getBoundingClientRect().toJSON()")
        before, scale = page.evaluate(here), page.evaluate("kcgs.scale")
        page.do("look", motion="no-preference")
        page.do("wheel", x=box["x"] + 300, y=box["y"] + 250, delta=-700)
        page.do("wait", expression=f"kcgs.scale > {2 * scale}")
        # the zoom takes several frames, which a busy machine draws so late that the view seems to be at rest
        page.evaluate(
            "(async () => { let before; do { before = kcgs.scale; await new Promise(requestAnimationFrame); }"
            " while (kcgs.scale !== before); })()"
        )
        page.settle()
        assert np.abs(np.subtract(page.evaluate(here), before)).max() <= 1 / scale
        rect = page.evaluate("kcgs.part.rect")
        page.do("drag", **{"from": [box["x"] + 300, box["y"] + 250]}, to=[box["x"] + 340, box["y"] + 250])
        assert page.evaluate("kcgs.part.rect[0]") == pytest.approx(rect[0] - 40 / page.evaluate("kcgs.scale"), abs=0.2)

    def test_pinch(self, page: Viewer) -> None:
        scale = page.evaluate("kcgs.scale")
        page.do("pinch", at=[300, 300], **{"from": 100}, to=300)
        assert page.evaluate("kcgs.scale") == pytest.approx(3 * scale, rel=0.02)

    def test_frames_do_not_pile_up(self, page: Viewer, decoder: Path) -> None:
        """Many moves while a frame is drawn ask for few frames, and the last view is what remains."""
        page.evaluate(
            "(() => { const {prototype} = Worker, {postMessage} = prototype; window.sent = 0;"
            "prototype.postMessage = function (...message) { window.sent++; postMessage.apply(this, message); };"
            "for (let i = 0; i < 200; i++)"
            " document.body.dispatchEvent(new KeyboardEvent('keydown', {key: i % 4 ? '+' : '-', bubbles: true})); })()"
        )
        part, got = page.canvas()
        assert 1 <= page.evaluate("window.sent") <= 4
        assert page.evaluate("kcgs.scale") == 200
        want = decode(decoder, (part["height"], part["width"]), view=part["rect"], visible=[1, 1, 1])
        np.testing.assert_allclose(got, np.clip(want, 0, 1), atol=LEVEL)


class TestCompare:
    def test_slider_by_keyboard(self, page: Viewer, decoder: Path, tmp_path: Path) -> None:
        assert page.evaluate("document.querySelector('[role=slider]').hidden") is True
        original = original_of(decoder, tmp_path / "original.png")
        page.do("files", on="#original-file", paths=[str(original)])
        page.do("wait", expression="kcgs.psnr !== null")
        page.do("click", on="#native")
        for key in ["Home", "PageUp", "PageUp", "PageUp", "PageUp", "PageUp", "ArrowLeft"]:
            page.do("press", key=key, on="[role=slider]")
        assert page.evaluate("document.querySelector('[role=slider]').ariaValueNow") == "49"
        part, got = page.canvas()
        width = page.evaluate("document.querySelector('#picture').width")
        edge = round(0.49 * width) - part["x"]
        shown = np.asarray(Image.open(original), dtype=np.float32).transpose(2, 0, 1) / 255
        decoded = decode(decoder, (HEIGHT, WIDTH), view=part["rect"], visible=[1, 1, 1])[0]
        assert 0 < edge < WIDTH
        np.testing.assert_allclose(got[0, ..., :edge], shown[..., :edge], atol=1e-6)
        np.testing.assert_allclose(got[0, ..., edge:], np.clip(decoded, 0, 1)[..., edge:], atol=LEVEL)

    def test_psnr(self, page: Viewer, decoder: Path, site: tuple[Path, str]) -> None:
        original = original_of(decoder, site[0] / "original.png")
        page.do("goto", url=f"{site[1]}?decoder=waves.onnx&original=original.png")
        page.do("wait", expression="kcgs.psnr !== null")
        decoded = decode(decoder, (HEIGHT, WIDTH), view=[0, 0, WIDTH, HEIGHT], visible=[1, 1, 1])[0]
        levels = np.asarray(Image.open(original), dtype=np.float64).transpose(2, 0, 1) / 255
        want = -10 * np.log10(np.mean((np.clip(decoded, 0, 1) - levels) ** 2))
        assert page.evaluate("kcgs.psnr") == pytest.approx(want, abs=1e-3)
        page.do("wait", expression="document.querySelector('#facts').textContent.includes(' dB')")
        facts = page.do("text", on="#facts")
        assert f"{want:.2f} dB" in facts and "1,234" in facts and f"{WIDTH} \u00d7 {HEIGHT}" in facts


class TestDrop:
    def test_decoder_and_original_together(self, page: Viewer, site: tuple[Path, str], decoder: Path) -> None:
        original_of(decoder, site[0] / "dropped.png")
        page.evaluate(
            "(async () => { const transfer = new DataTransfer();"
            "for (const [name, type] of [['dropped.png', 'image/png'], ['waves.onnx', '']])"
            " transfer.items.add(new File([await (await fetch(name)).blob()], name, {type}));"
            "dispatchEvent(new DragEvent('drop', {dataTransfer: transfer, cancelable: true})); })()"
        )
        page.do("wait", expression="kcgs.psnr !== null")
        assert page.evaluate("document.querySelector('[role=slider]').hidden") is False


class TestExamples:
    def test_first_example_opens_by_itself(self, page: Viewer, site: tuple[Path, str], decoder: Path) -> None:
        folder = site[0] / "examples"
        folder.mkdir()
        shutil.copy(decoder, folder / "stripes.onnx")
        original_of(decoder, folder / "stripes.png")
        listed = {"name": "Stripes", "decoder": "stripes.onnx", "original": "stripes.png", "note": "Three of them"}
        try:
            (folder / "index.json").write_text(json.dumps([listed, {"name": "no decoder"}]))
            page.do("goto", url=site[1])
            page.do("wait", expression="kcgs.psnr !== null")
            assert page.do("text", on="#examples").split("\n") == ["Stripes", "Three of them"]
            for content in ("[]", "{", "null"):
                (folder / "index.json").write_text(content)
                page.do("goto", url=site[1])
                assert page.evaluate("kcgs.ready.then(() => kcgs.metadata)") is None and page.alert() == ""
        finally:
            shutil.rmtree(folder)


GOLDEN = WEB.parent / "golden"
MODELS = WEB.parents[1] / "models"


class TestRealDecoders:
    """What kcgs exports, in the browser."""

    @pytest.mark.parametrize("name", sorted(path.stem for path in GOLDEN.glob("*.npz")))
    def test_golden(self, page: Viewer, site: tuple[Path, str], name: str) -> None:
        shutil.copy(GOLDEN / f"{name}.onnx", site[0])
        page.evaluate(f"kcgs.open('{name}.onnx')")
        page.settle()
        assert page.alert() == ""
        with np.load(GOLDEN / f"{name}.npz") as case:
            height, width = int(case["height"]), int(case["width"])
            whole, every = [0, 0, width, height], [1.0] * len(page.evaluate("kcgs.metadata.regionIds"))
            pictures = [key for key in case.files if re.fullmatch(r"image_\d+x\d+", key)]
            assert len(pictures) == 3
            for key in pictures:
                got = page.render(case[key].shape[-2:], view=whole, visible=every)
                np.testing.assert_allclose(got[0], case[key], atol=1e-3)
            got = page.render(case["image_view"].shape[-2:], view=case["view"].tolist(), visible=every)
            np.testing.assert_allclose(got[0], case["image_view"], atol=1e-3)
            if "visible" in case.files:
                shape = case["image_visible"].shape[-2:]
                got = page.render(shape, view=whole, visible=case["visible"].tolist())
                np.testing.assert_allclose(got[0], case["image_visible"], atol=1e-3)

    @pytest.mark.parametrize("name", ["chelsea-500", "chart-pie"])
    def test_bundled_example(self, page: Viewer, site: tuple[Path, str], name: str) -> None:
        path = site[0] / f"{name}.onnx"
        shutil.copy(MODELS / name / "decoder.onnx", path)
        page.evaluate(f"kcgs.open('{name}.onnx')")
        part, got = page.canvas()
        every = [1.0] * len(page.evaluate("kcgs.metadata.regionIds"))
        want = decode(path, (part["height"], part["width"]), view=part["rect"], visible=every)
        np.testing.assert_allclose(got, np.clip(want, 0, 1), atol=LEVEL)

    def test_examples_are_copied_from_the_zoo(self, node_modules: Path) -> None:
        assert npm("run", "examples").returncode == 0
        listed = json.loads((WEB / "public" / "examples" / "index.json").read_text())
        assert [example["name"] for example in listed] == ["chelsea-500", "chart-pie"]
        for example in listed:
            for file in (example["decoder"], example["original"]):
                assert (WEB / "public" / "examples" / file).stat().st_size > 0


class TestSources:
    """What needs node alone."""

    def test_types_and_units(self, node_modules: Path) -> None:
        for script in ("check", "test"):
            done = npm("run", script)
            assert done.returncode == 0, done.stdout + done.stderr

    def test_versions_are_pinned(self) -> None:
        package = json.loads((WEB / "package.json").read_text())
        versions = [*package["dependencies"].values(), *package["devDependencies"].values()]
        assert all(version.replace(".", "").isdigit() for version in versions)

    def test_only_needed_files_are_shipped(self, site: tuple[Path, str]) -> None:
        assets = sorted(os.listdir(site[0] / "assets"))
        assert [Path(name).suffix for name in assets].count(".wasm") == 2
        assert not any(name.endswith((".mjs", ".map")) for name in assets)
