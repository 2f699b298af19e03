"""The element `<kcgs-image>` and the page of a scene, in headless Chromium, against `Scene.render` in Python."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kcgs import GaussianField, RegionMap, Scene, load
from kcgs.codec import encode
from kcgs.editing import move_region, recolor_region
from kcgs.page import scene_page

from .browser import WEB, Browser, Handler, array, build, check_npm, serving

MODELS = WEB.parents[1] / "models"
PAGE = WEB.parents[1] / "kcgs" / "page"
ZOO = ("chelsea-500", "rocket-1000")
MOST_BYTES = 39_000  # of the element, compressed by gzip
LEVELS = 2 / 255
HTML = """<!doctype html><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; connect-src 'self'; img-src blob: 'self';
 script-src 'self' 'wasm-unsafe-eval' 'nonce-test'">
<script type="module" src="kcgs-image.js"></script>
<script type="module" nonce="test">
const events = [];
window.kcgs = { events, async show(markup) {
  document.querySelector("#here").innerHTML = markup;
  const image = document.querySelector("kcgs-image");
  for (const name of ["load", "error", "progress", "regionclick"])
    image.addEventListener(name, (e) => events.push([name, e.message ?? e.detail ?? image.scene?.complete]));
  window.image = image;
  events.length = 0;
  while (!events.some(([name]) => name === "load" || name === "error")) await new Promise((r) => setTimeout(r, 5));
  await image.settled();
}, async pixels(width, height) {
  const bitmap = await createImageBitmap(await image.toBlob({ width, height }));
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d");
  context.drawImage(bitmap, 0, 0);
  return { data: Float32Array.from(context.getImageData(0, 0, width, height).data), dims: [height, width, 4] };
} };
</script>
<div id="here"></div>
"""


def cells(size: tuple[int, int], count: int) -> torch.Tensor:
    """Label pixels by the nearest of some points, ids 2, 5, 8 ..."""
    generator = torch.Generator().manual_seed(count)
    places = torch.rand(count, 2, generator=generator) * torch.tensor(size)
    rows, columns = (torch.arange(n, dtype=torch.float32) for n in size)
    squares = (rows[:, None, None] - places[:, 0]) ** 2 + (columns[None, :, None] - places[:, 1]) ** 2
    return squares.argmin(-1) * 3 + 2


def zoo(name: str) -> Scene:
    return load(MODELS / name / "scene.safetensors")


@cache
def layered_file() -> bytes:
    """A file of several layers."""
    return encode(zoo("coffee-1500"))


def random_scene(kind: str, channels: int = 3) -> Scene:
    size = (60, 90)
    softness: Any = {"soft": 1.3, "grey": 1.3, "wide": 5.0, "widest": 24.0}.get(kind, 0.0)
    labels = cells(size, 12)
    if kind == "pairs":
        ids = labels.unique().tolist()
        pairs = [(a, b) for a in ids for b in ids if a < b]
        softness = {pair: (0.0, 0.5, 1.0, 2.5)[i % 4] for i, pair in enumerate(pairs)}
    regions = None if kind == "plain" else RegionMap(labels, softness)
    return Scene(GaussianField.random(150, size, channels=channels, regions=regions, seed=1), regions)


SCENES = [
    "pairs",
    "hard",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("plain", "wide", "widest", "grey", *ZOO)),
]


@pytest.fixture(scope="module")
def site(node_modules: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A folder with the built element and a page, and its address."""
    folder = tmp_path_factory.mktemp("element")
    check_npm("exec", "--", "vite", "build", "--mode", "element", "--outDir", str(folder))
    (folder / "index.html").write_text(HTML)
    (folder / "grey.png").write_bytes(b"")
    with serving(folder) as address:
        yield folder, address


@pytest.fixture
def page(browser: Browser, site: tuple[Path, str]) -> Iterator[Browser]:
    """The page; when a test ends nothing may have gone wrong, nor been asked of another server."""
    browser.do("look", width=1000, height=700)
    browser.do("open", url=site[1])
    yield browser
    assert all(address.startswith((site[1], f"blob:{site[1]}")) for address in browser.do("requests"))
    assert [text for text in browser.do("problems") if "404" not in text] == []


def show(page: Browser, site: tuple[Path, str], scene: Scene | bytes, attributes: str = "", inside: str = "") -> Scene:
    """Put a scene into the page's element; return what its file holds."""
    path = site[0] / "scene.kcgs"
    path.write_bytes(scene if isinstance(scene, bytes) else encode(scene))
    markup = f'<kcgs-image src="scene.kcgs" {attributes}>{inside}</kcgs-image>'
    page.evaluate(f"kcgs.show({json.dumps(markup)})")
    return load(path) if not isinstance(scene, bytes) else Scene(GaussianField.random(1, (1, 1)))


def widen(page: Browser, width: int) -> None:
    """Set the element's width; wait until its canvas has it, too."""
    page.evaluate(f"(image.style.setProperty('width', '{width}px'), 1)")
    page.do("wait", expression=f"image.shadowRoot.querySelector('canvas').width === {width}")


def pixels(page: Browser, size: tuple[int, int]) -> NDArray[np.float32]:
    """Render in the element at a size: (4, H, W) in [0, 1]."""
    return array(page.evaluate(f"kcgs.pixels({size[1]}, {size[0]})")).transpose(2, 0, 1) / 255


def check(page: Browser, expected: torch.Tensor) -> None:
    image = pixels(page, (expected.shape[-2], expected.shape[-1]))
    assert expected.std() > 0.02
    np.testing.assert_allclose(image[:3], expected.expand(3, -1, -1).numpy(), atol=LEVELS, rtol=0)


class TestPixels:
    @pytest.mark.parametrize("renderer", ["cpu", "webgl2"])
    @pytest.mark.parametrize("name", SCENES)
    def test_sizes(self, page: Browser, site: tuple[Path, str], name: str, renderer: str) -> None:
        scene = zoo(name) if name in ZOO else random_scene(name, 1 if name == "grey" else 3)
        scene = show(page, site, scene, f'renderer="{renderer}"')
        assert page.evaluate("image.renderer").startswith(renderer)
        height, width = scene.size
        for size in ((height, width), (height // 2, width // 2), (height - 13, 3 * width + 5)):
            check(page, scene.render(size))

    def test_alpha(self, page: Browser, site: tuple[Path, str]) -> None:
        scene = show(page, site, random_scene("soft", 4))
        expected = scene.render().numpy()
        for renderer in ("cpu", "webgl2"):
            page.evaluate(f"(image.setAttribute('renderer', '{renderer}'), 1)")
            image = pixels(page, scene.size)
            np.testing.assert_allclose(image[3], expected[3], atol=LEVELS)
            np.testing.assert_allclose(image[:3] * image[3], expected[:3] * expected[3], atol=LEVELS)

    def test_sums_of_16_bits(self, page: Browser, site: tuple[Path, str]) -> None:
        """As on a GPU that does not blend floats of 32 bits."""
        page.evaluate(
            "(() => { const find = WebGL2RenderingContext.prototype.getExtension;"
            "WebGL2RenderingContext.prototype.getExtension = function (name) {"
            "  return name === 'EXT_float_blend' ? null : find.call(this, name); }; return 1; })()"
        )
        scene = show(page, site, random_scene("soft"), 'renderer="webgl2"')
        assert page.evaluate("image.renderer") == "webgl2 float16"
        check(page, scene.render())

    @pytest.mark.parametrize("renderer", ["cpu", "webgl2"])
    def test_hidden_regions_are_clear(self, page: Browser, site: tuple[Path, str], renderer: str) -> None:
        scene = show(page, site, random_scene("soft"), f'renderer="{renderer}"')
        regions = scene.regions
        assert regions is not None
        hidden = regions.ids[:3].tolist()
        page.evaluate(f"(image.hide({hidden}), image.hide({hidden[2]}, false), 1)")
        image = pixels(page, scene.size)
        membership = regions.membership(regions.ids[2:].tolist()).numpy()
        np.testing.assert_allclose(image[3], membership, atol=LEVELS)
        inside = membership > 1 - 1e-6
        np.testing.assert_allclose(image[:3, inside], scene.render().numpy()[:, inside], atol=LEVELS)


class TestEdits:
    def test_as_python_edits(self, page: Browser, site: tuple[Path, str]) -> None:
        # no pixel of the regions that move is as far from one neighbour as from another
        labels = torch.bucketize(torch.arange(90), torch.tensor([19, 43, 67])).expand(60, -1)
        widths = {(0, 1): 0.5, (1, 2): 0.0, (2, 3): 2.5}
        regions = RegionMap(labels, widths)
        scene = show(page, site, Scene(GaussianField.random(150, (60, 90), regions=regions, seed=1), regions))
        first, second = 1, 2
        page.evaluate(f"(image.move([{first}, {second}], 11, -7), 1)")
        moved = move_region(scene, [first, second], (11, -7), fill=False)
        check(page, moved.render())
        page.evaluate(f"(image.recolor({first}, [0.5, 1, -1], [0.1, 0, 0.9]), 1)")
        check(page, recolor_region(moved, first, [0.5, 1, -1], [0.1, 0.0, 0.9]).render())
        page.evaluate("(image.reset(), 1)")
        check(page, scene.render())

    def test_errors(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, random_scene("soft"))
        for call, message in {
            "hide(77)": "ids must be of the scene's regions; got 77",
            "move(5, 0.3, 0)": "dx and dy must be whole; got 0.3, 0",
            "recolor(5, [1, 2])": "gain must be a number or 3 of them; got 1,2",
            "zoomBy(-1)": "factor must be 0 or more; got -1",
            "toBlob({width: 0.5})": "width must be a whole number of pixels, 1 or more; got 0.5",
            "toBlob({width: 1e5, height: 1e5})": "no image of 100000 x 100000 can be made",
        }.items():
            attempt = f"try {{ await image.{call}; return ''; }} catch (error) {{ return error.message; }}"
            assert page.evaluate(f"(async () => {{ {attempt} }})()") == message


class TestElement:
    def test_size_and_role(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, random_scene("soft"), 'alt="Cells"', '<img src="grey.png" alt="instead">')
        facts = "[image.offsetWidth, image.offsetHeight, image.querySelector('img').offsetWidth, image.tabIndex]"
        assert page.evaluate(facts) == [90, 60, 0, -1]
        widen(page, 300)
        assert page.evaluate("[image.offsetHeight, image.shadowRoot.querySelector('canvas').height]") == [200, 200]
        assert page.evaluate("document.querySelector('kcgs-image').matches(':focus')") is False

    def test_pixels_of_a_dense_screen(self, page: Browser, site: tuple[Path, str]) -> None:
        page.do("density", ratio=2.5)
        try:
            show(page, site, random_scene("soft"), 'alt="Cells"')
            canvas = "image.shadowRoot.firstChild"
            assert page.evaluate(f"[image.offsetWidth, {canvas}.width, {canvas}.height]") == [90, 225, 150]
        finally:
            page.do("density", ratio=1)

    def test_what_a_screen_reader_is_told(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, random_scene("soft"), 'zoom alt="Cells"')
        assert ["image", "Cells"] in page.do("accessible") and page.evaluate("image.tabIndex") == 0
        page.evaluate("(image.alt = '', image.setAttribute('alt', ''), 1)")
        assert "image" not in [role for role, _ in page.do("accessible")]

    def test_layers_as_they_arrive(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, layered_file())
        Handler.release.clear()
        page.evaluate("(window.shown = kcgs.show('<kcgs-image src=slow/scene.kcgs></kcgs-image>'), 1)")
        page.do("wait", expression="kcgs.events.length > 0")
        Handler.release.set()
        page.evaluate("shown")
        first, *_, last = page.evaluate("kcgs.events")
        assert first == ["progress", False] and last == ["load", True]

    def test_leaves_the_page_and_comes_back(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, layered_file())
        Handler.release.clear()
        page.evaluate(
            "(async () => { const here = document.querySelector('#here'), slow = document.createElement('kcgs-image');"
            "let next = new Promise((r) => (slow.onprogress = r)); slow.setAttribute('src', 'slow/scene.kcgs');"
            "here.replaceChildren(slow); await next; slow.remove(); here.append(slow); window.image = slow; })()"
        )
        Handler.release.set()
        page.do("wait", expression="image.scene?.complete === true")
        page.evaluate("(image.remove(), image.setAttribute('src', 'none.kcgs'), document.body.append(image), 1)")
        page.do("wait", expression="image.scene === null")

    def test_a_file_that_ends_early_shows_what_is_whole(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, layered_file()[: len(layered_file()) * 3 // 4])
        *progress, last = [name for name, _ in page.evaluate("kcgs.events")]
        assert set(progress) == {"progress"} and last == "error"
        assert "ends early" in page.evaluate("kcgs.events.at(-1)[1]")
        assert page.evaluate("[image.scene.complete, image.shadowRoot.firstChild.hidden]") == [False, False]
        assert pixels(page, (300, 451)).std() > 0.1

    @pytest.mark.parametrize(("src", "words"), [("none.kcgs", "404"), ("index.html", 'must start with "kcgs"')])
    def test_the_fallback_stays(self, page: Browser, src: str, words: str) -> None:
        inside = "<p>instead</p>"
        page.evaluate(f"kcgs.show({json.dumps(f'<kcgs-image src={src}>{inside}</kcgs-image>')})")
        name, message = page.evaluate("kcgs.events.at(-1)")
        assert name == "error" and words in message
        assert page.evaluate("image.querySelector('p').offsetHeight") > 0

    def test_keyboard_wheel_and_touch(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, random_scene("soft"), 'zoom regions alt="Cells"')
        widen(page, 600)
        whole = page.evaluate("image.view.scale")
        page.evaluate("(image.focus(), 1)")
        for key, larger in (("+", True), ("0", False)):
            page.do("press", key=key, on="kcgs-image")
            page.evaluate("image.settled()")
            assert (page.evaluate("image.view.scale") > 1.2 * whole) is larger
        page.do("wheel", x=100, y=100, delta=-400)
        page.do("wait", expression=f"image.view.scale > {1.5 * whole}")
        near, x = page.evaluate("image.settled().then(() => [image.view.scale, image.view.x])")
        page.do("press", key="ArrowRight", on="kcgs-image")
        assert page.evaluate("image.settled().then(() => image.view.x)") > x
        page.do("pinch", at=[300, 200], **{"from": 60, "to": 180})
        assert page.evaluate("image.settled().then(() => image.view.scale)") > 1.5 * near
        page.do("drag", **{"from": [300, 200], "to": [340, 200]})
        assert "regionclick" not in [name for name, _ in page.evaluate("kcgs.events")]

    def test_a_wheel_that_needs_ctrl(self, page: Browser, site: tuple[Path, str]) -> None:
        show(page, site, random_scene("soft"), "zoom=ctrl")
        turn = "image.shadowRoot.firstChild.dispatchEvent(new WheelEvent('wheel', {{deltaY: -50, cancelable: true{}}}))"
        assert page.evaluate(f"[{turn.format('')}, image.view.scale]") == [True, 1]
        assert page.evaluate(f"{turn.format(', ctrlKey: true')} || image.view.scale > 1.2")

    def test_a_click_tells_the_region(self, page: Browser, site: tuple[Path, str]) -> None:
        scene = show(page, site, random_scene("hard"), "regions")
        assert scene.regions is not None
        page.do("click", on="kcgs-image")
        page.do("press", key="Enter", on="kcgs-image")
        (_, click), (_, enter) = [event for event in page.evaluate("kcgs.events") if event[0] == "regionclick"]
        assert click["id"] == enter["id"] == int(scene.regions.labels[30, 45])


class TestPage:
    def test_opens_from_disk_and_asks_nothing(self, browser: Browser, node_modules: Path, tmp_path: Path) -> None:
        scene = random_scene("pairs")
        path = tmp_path / "page.html"
        path.write_text(scene_page(scene, title='"Cells" & more'), encoding="utf-8")
        browser.do("open", url=path.as_uri())
        browser.do("wait", expression="document.querySelector('#note').textContent.includes('Gaussians')")
        assert browser.evaluate("document.title") == '"Cells" & more'
        browser.evaluate("document.querySelector('kcgs-image').settled()")
        assert browser.evaluate("document.querySelector('kcgs-image').renderer") == "cpu"
        browser.do("click", on="#bar button:last-of-type")
        assert len(browser.do("text", on="#regions").split("Region")) == scene.regions.num_regions + 1  # type: ignore[union-attr]
        browser.do("click", on="#regions label:nth-child(1) input")
        browser.do("click", on="#bar button:nth-of-type(2)")
        browser.evaluate("document.querySelector('kcgs-image').settled()")
        assert browser.evaluate("document.querySelector('kcgs-image').view.scale") > 1
        assert browser.do("requests") == [path.as_uri()] and browser.do("problems") == []


class TestSources:
    def test_small_enough(self, site: tuple[Path, str]) -> None:
        assert len(gzip.compress((site[0] / "kcgs-image.js").read_bytes(), 9)) <= MOST_BYTES

    def test_python_has_the_scripts_that_are_built(self, site: tuple[Path, str], tmp_path: Path) -> None:
        check_npm("exec", "--", "vite", "build", "--mode", "page", "--outDir", str(tmp_path))
        for built in (tmp_path / "page.js", site[0] / "kcgs-image.js"):
            assert built.read_text() == (PAGE / built.name).read_text(), "run make page, and commit kcgs/page"

    def test_the_package(self, node_modules: Path, tmp_path: Path) -> None:
        build("build:element")
        (packed,) = json.loads(
            check_npm("pack", "--prefix", "element", "--json", "--pack-destination", str(tmp_path), "./element")
        )
        names = {file["path"] for file in packed["files"]}
        assert {"package.json", "README.md", "dist/kcgs-image.js", "dist/types/element/index.d.ts"} <= names
        assert not any(name.endswith((".ts",)) and not name.endswith(".d.ts") for name in names)
        package = json.loads((WEB / "element" / "package.json").read_text())
        assert "dependencies" not in package
        shutil.rmtree(WEB / "element" / "dist")
