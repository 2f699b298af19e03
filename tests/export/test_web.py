"""The page of docs/onnx.md that runs a decoder by onnxruntime-web, in Chromium, against onnxruntime in Python."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.typing import NDArray

from kcgs import load
from kcgs.onnx import scene_decoder

from .browser import WEB, Browser, array, npm, serving

ROOT = WEB.parents[1]
GOLDEN = WEB.parent / "golden"
LEVEL = 1 / 255
# what a test asks of the page: to rest, and what it shows
HOOK = """
window.page = {
  get view() { return view; },
  rest: async () => { while (running || stale) await new Promise((wait) => setTimeout(wait, 5)); },
  pixels: () => ({ data: Float32Array.from(context.getImageData(0, 0, canvas.width, canvas.height).data),
    dims: [canvas.height, canvas.width, 4] }),
};
</script>"""


@pytest.fixture(scope="module")
def source() -> str:
    (found,) = re.findall(r"```html\n(<!doctype.*?)```", (ROOT / "docs" / "onnx.md").read_text(), re.DOTALL)
    return str(found)


@pytest.fixture(scope="module")
def site(node_modules: Path, source: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """The page, with onnxruntime-web beside it in place of the network's, and its address."""
    folder = tmp_path_factory.mktemp("site")
    version = json.loads((WEB / "package.json").read_text())["devDependencies"]["onnxruntime-web"]
    network = f"https://cdn.jsdelivr.net/npm/onnxruntime-web@{version}/dist/"
    assert source.count(network) == source.count("https:") == 1
    (folder / "ort").symlink_to(node_modules / "onnxruntime-web" / "dist")
    page = source.replace(network, "./ort/").replace("</script>", HOOK)
    (folder / "index.html").write_text(page)
    with serving(folder) as address:
        yield folder, address


@pytest.fixture(scope="module")
def browser(chromium: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    driven = Browser(chromium, tmp_path_factory.mktemp("browser") / "errors.txt")
    yield driven
    driven.close()


def open_page(browser: Browser, site: tuple[Path, str], decoder: Path, size: tuple[int, int]) -> None:
    """Open the page with a decoder of a scene of this size."""
    folder, address = site
    shutil.copy(decoder, folder / "decoder.onnx")
    text = (folder / "index.html").read_text()
    scene = f"const scene = {{ width: {size[1]}, height: {size[0]} }};"
    (folder / "scene.html").write_text(re.sub(r"const scene = .*;", scene, text))
    browser.do("look", width=700, height=700)
    browser.do("open", url=address + "scene.html")
    browser.do("wait", expression="window.page !== undefined")


def shown(browser: Browser) -> NDArray[np.float32]:
    """Wait until the page rests; give its canvas, (3, H, W) in [0, 1]."""
    browser.evaluate("page.rest()")
    pixels = array(browser.evaluate("page.pixels()")) / 255
    assert pixels[..., 3].min() == 1
    return pixels[..., :3].transpose(2, 0, 1)


def decode(browser: Browser, decoder: Path, hidden: int | None = None) -> NDArray[np.float32]:
    """Render in Python what the page shows."""
    session = onnxruntime.InferenceSession(decoder, providers=["CPUExecutionProvider"])
    size = browser.evaluate("page.pixels().dims.slice(0, 2)")
    visible = np.ones(session.get_inputs()[2].shape, np.float32)
    if hidden is not None:
        visible[hidden] = 0
    view = np.array(browser.evaluate("page.view"), np.float32)
    (image,) = session.run(["image"], {"size": np.array(size), "view": view, "visible": visible})
    return np.asarray(np.clip(image[0, :3], 0, 1), np.float32)


class TestPage:
    def test_short_enough_to_copy(self, source: str) -> None:
        assert source.count("\n") <= 60

    def test_zoom_drag_and_hide(self, browser: Browser, site: tuple[Path, str], tmp_path: Path) -> None:
        scene, decoder = load(ROOT / "models" / "chelsea-500" / "scene.safetensors"), tmp_path / "decoder.onnx"
        onnx.save(scene_decoder(scene, interactive=True), decoder)
        open_page(browser, site, decoder, scene.size)
        whole = shown(browser)
        assert browser.evaluate("page.view") == [0, 0, 451, 300] and whole.std() > 0.1
        np.testing.assert_allclose(whole, decode(browser, decoder), atol=LEVEL)
        browser.do("wheel", x=300, y=200, delta=-600)
        near = shown(browser)
        left, top, right, bottom = browser.evaluate("page.view")
        assert 0 < left < right < 451 and 0 < top < bottom < 300
        np.testing.assert_allclose(near, decode(browser, decoder), atol=LEVEL)
        browser.do("drag", **{"from": [300, 200], "to": [340, 220]})
        moved = shown(browser)
        after = browser.evaluate("page.view")
        assert after[0] < left and after[1] < top and after[2] - after[0] == pytest.approx(right - left)
        np.testing.assert_allclose(moved, decode(browser, decoder), atol=LEVEL)
        browser.do("wheel", x=300, y=200, delta=2000)
        browser.do("click", on="input:nth-of-type(1)")
        hidden = shown(browser)
        assert (hidden == 0).all(axis=0).mean() > 0.1
        np.testing.assert_allclose(hidden, decode(browser, decoder, hidden=0), atol=LEVEL)
        assert all(address.startswith((site[1], "blob:", "data:")) for address in browser.do("requests"))
        assert [text for text in browser.do("problems") if "favicon" not in text and "404" not in text] == []

    @pytest.mark.parametrize("name", sorted(path.stem for path in GOLDEN.glob("*.npz")))
    def test_golden(self, browser: Browser, site: tuple[Path, str], name: str) -> None:
        with np.load(GOLDEN / f"{name}.npz") as case:
            open_page(browser, site, GOLDEN / f"{name}.onnx", (int(case["height"]), int(case["width"])))
        np.testing.assert_allclose(shown(browser), decode(browser, GOLDEN / f"{name}.onnx"), atol=LEVEL)


class TestSources:
    """What needs node alone."""

    def test_types_and_units(self, node_modules: Path) -> None:
        for script in ("check", "test"):
            done = npm("run", script)
            assert done.returncode == 0, done.stdout + done.stderr

    def test_versions_are_pinned(self) -> None:
        versions = json.loads((WEB / "package.json").read_text())["devDependencies"].values()
        assert all(version.replace(".", "").isdigit() for version in versions)
