"""The page of docs/onnx.md that runs a decoder by onnxruntime-web, in Chromium, against onnxruntime in Python."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from .browser import WEB, Browser, array, check_npm, serving

GOLDEN = WEB.parent / "golden"
NAME = "soft"  # the scene that the page shows
LEVEL = 1 / 255
# what a test asks of the page: to render all that it was asked to, its pixels, and the image of another decoder
HOOK = """
window.page = {
  get view() { return view; },
  async settled() { while (running || stale) await new Promise((resolve) => setTimeout(resolve, 5)); },
  pixels: () => ({ data: Float32Array.from(context.getImageData(0, 0, canvas.width, canvas.height).data),
    dims: [canvas.height, canvas.width, 4] }),
  async decode(name, size, view, visible) {
    const session = await ort.InferenceSession.create(name, { executionProviders: ["wasm"] });
    const { image } = await session.run({ size: new ort.Tensor("int64", size), view: new ort.Tensor("float32", view),
      visible: new ort.Tensor("float32", visible) });
    return { data: image.data, dims: image.dims.map(Number) };
  },
};
</script>"""


def load(name: str) -> dict[str, NDArray[np.float32]]:
    with np.load(GOLDEN / f"{name}.npz") as case:
        return dict(case)


@pytest.fixture(scope="module")
def source() -> str:
    (page,) = re.findall(r"```html\n(<!doctype.*?)```", (WEB.parents[1] / "docs" / "onnx.md").read_text(), re.DOTALL)
    return str(page)


@pytest.fixture(scope="module")
def address(node_modules: Path, source: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The page and the golden decoders, with onnxruntime-web beside them in place of the network's."""
    folder = tmp_path_factory.mktemp("site")
    version = json.loads((WEB / "package.json").read_text())["devDependencies"]["onnxruntime-web"]
    network = f"https://cdn.jsdelivr.net/npm/onnxruntime-web@{version}/dist/"
    assert source.count(network) == source.count("https:") == 1
    (folder / "ort").symlink_to(node_modules / "onnxruntime-web" / "dist")
    for decoder in GOLDEN.glob("*.onnx"):
        (folder / decoder.name).symlink_to(decoder)
    case = load(NAME)
    scene = f"const scene = {{ width: {case['width']}, height: {case['height']} }};"
    page = source.replace(network, "./ort/").replace("decoder.onnx", f"{NAME}.onnx").replace("</script>", HOOK)
    (folder / "index.html").write_text(re.sub(r"const scene = .*;", scene, page))
    with serving(folder) as address:
        yield address


@pytest.fixture(scope="module")
def page(browser: Browser, address: str) -> Browser:
    """The page, opened."""
    browser.do("look", width=320, height=400)
    browser.do("open", url=address)
    browser.do("wait", expression="window.page !== undefined")
    return browser


def pixels(page: Browser) -> NDArray[np.float32]:
    """Wait until the page is settled; return its canvas, (3, H, W) in [0, 1]."""
    page.evaluate("page.settled()")
    canvas = array(page.evaluate("page.pixels()")) / 255
    assert canvas[..., 3].min() == 1
    return canvas[..., :3].transpose(2, 0, 1)


def decode(page: Browser, hidden: int | None = None) -> NDArray[np.float32]:
    """Render in Python what the page shows."""
    session = onnxruntime.InferenceSession(GOLDEN / f"{NAME}.onnx", providers=["CPUExecutionProvider"])
    visible = np.ones(session.get_inputs()[2].shape, np.float32)
    if hidden is not None:
        visible[hidden] = 0
    size, view = page.evaluate("[page.pixels().dims.slice(0, 2), page.view]")
    feeds = {"size": np.array(size), "view": np.array(view, np.float32), "visible": visible}
    return np.asarray(np.clip(session.run(["image"], feeds)[0][0], 0, 1), np.float32)


class TestPage:
    def test_short_enough_to_copy(self, source: str) -> None:
        assert source.count("\n") <= 60

    def test_zoom_drag_and_hide(self, page: Browser, address: str) -> None:
        case = load(NAME)
        width, height = int(case["width"]), int(case["height"])
        whole = pixels(page)
        assert page.evaluate("page.view") == [0, 0, width, height] and whole.std() > 0.05
        np.testing.assert_allclose(whole, decode(page), atol=LEVEL)
        page.do("wheel", x=150, y=90, delta=-600)
        page.do("wait", expression=f"page.view[2] - page.view[0] < {0.9 * width}")
        near = pixels(page)
        left, top, right, bottom = page.evaluate("page.view")
        assert 0 < left < right < width and 0 < top < bottom < height
        np.testing.assert_allclose(near, decode(page), atol=LEVEL)
        page.do("drag", **{"from": [150, 90], "to": [180, 100]})
        page.do("wait", expression=f"page.view[0] < {left}")
        moved = pixels(page)
        view = page.evaluate("page.view")
        assert view[1] < top and view[2] - view[0] == pytest.approx(right - left)
        np.testing.assert_allclose(moved, decode(page), atol=LEVEL)
        page.do("wheel", x=150, y=90, delta=2000)
        page.do("wait", expression=f"page.view[2] - page.view[0] === {width}")
        page.do("click", on="input:nth-of-type(1)")
        hidden = pixels(page)
        assert (hidden == 0).all(axis=0).mean() > 0.1
        np.testing.assert_allclose(hidden, decode(page, hidden=0), atol=LEVEL)
        assert all(url.startswith((address, "blob:", "data:")) for url in page.do("requests"))
        assert [text for text in page.do("problems") if "favicon" not in text and "404" not in text] == []

    @pytest.mark.parametrize("name", ["needle", "pairs"])
    def test_golden(self, page: Browser, name: str) -> None:
        case = load(name)
        expected = case["image_view"]
        visible = np.ones_like(case.get("visible", np.ones(1)))
        feeds = [list(expected.shape[1:]), case["view"].tolist(), visible.tolist()]
        image = array(page.evaluate(f"page.decode('{name}.onnx', ...{json.dumps(feeds)})"))
        np.testing.assert_allclose(image[0], expected, atol=1e-3)


class TestSources:
    """What needs node alone."""

    @pytest.mark.parametrize("script", ["check", "test"])
    def test_types_and_units(self, node_modules: Path, script: str) -> None:
        check_npm("run", script)
