"""The web's decoder of `.kcgs` against Python's: the same bits, or an error, on every file."""

from __future__ import annotations

import math
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene, codec, load
from kcgs.codec import encode
from kcgs.codec.file import unpack
from kcgs.maps import touching_pairs

from ..codec.damage import damaged, damaged_inside
from .browser import WEB, Browser, check_npm, compile_decoder, serving
from .decoding import Node, Page, Reader, check_same

MODELS = WEB.parents[1] / "models"
GOLDEN = WEB.parents[1] / "tests" / "codec" / "golden.kcgs"
MEMORY = 1 << 30  # that node, which has about 50 MB at first, may take at most


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The decoder, built as `npm run build` builds it."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    if not (WEB / "node_modules" / "vite").exists():
        pytest.skip("export/web has no node_modules, with which its decoder is built: npm --prefix export/web ci")
    compile_decoder()
    folder = tmp_path_factory.mktemp("decoder")
    check_npm("exec", "--", "vite", "build", "--mode", "decoder", "--outDir", str(folder))
    return folder


PAGE = """<!doctype html>
<script type="module">
import { decode } from "./decoder.js";
import { attempt, describeScene } from "./describe.mjs";
const bytes = async (url) => new Uint8Array(await (await fetch(url)).arrayBuffer());
window.kcgs = {
  describe: async (url) => { const file = await bytes(url); return attempt(() => describeScene(decode(file))); },
};
</script>
"""


@pytest.fixture(scope="module")
def site(bundle: Path) -> Iterator[tuple[Path, str]]:
    """A page with the decoder, and its address."""
    shutil.copy(WEB / "test" / "describe.mjs", bundle)
    (bundle / "index.html").write_text(PAGE)
    with serving(bundle) as address:
        yield bundle, address


@pytest.fixture(scope="module")
def node(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    running = Node(bundle, tmp_path_factory.mktemp("node"))
    yield running
    running.close()


def random_labels(generator: np.random.Generator, size: tuple[int, int], regions: int) -> np.ndarray:
    """Cells about random points, with specks now and then, and ids of all kinds."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    places = generator.integers(0, size, (regions, 2))
    nearest = ((rows[..., None] - places[:, 0]) ** 2 + (columns[..., None] - places[:, 1]) ** 2).argmin(-1)
    if generator.random() < 0.3:
        noise = generator.choice([0.002, 0.02, 0.5])
        nearest = np.where(generator.random(size) < noise, generator.integers(0, regions, size), nearest)
    kind = generator.integers(3)
    if kind == 0:
        return nearest
    most = 1 << (16 if kind == 1 else 62)
    return np.unique(generator.integers(0, most, regions + 200))[: regions + 1][generator.permutation(regions)][nearest]


def random_scene(seed: int) -> Scene:
    """Gaussians of all sizes, angles and strengths, some outside the image, with any map that a file may hold."""
    generator = np.random.default_rng(seed)
    size = (int(generator.integers(1, 60)), int(generator.integers(1, 90)))
    count, channels = int(generator.integers(1, 300)), 1 + seed % 4
    means = (1.4 * generator.random((count, 2)) - 0.2) * size[::-1]
    wide, long = 0.3 * 60.0 ** generator.random((2, count))
    angle = math.pi * generator.random(count)
    l11 = np.sqrt((wide * np.cos(angle)) ** 2 + (long * np.sin(angle)) ** 2)
    l21 = (wide**2 - long**2) * np.cos(angle) * np.sin(angle) / l11
    colors = generator.normal(size=(count, channels)) * 3.0 ** (-4 * generator.random((count, 1)))
    numbers = (torch.from_numpy(n).float() for n in (means, np.stack([l11, l21, wide * long / l11], -1), colors))
    regions = int(generator.choice([1, 2, 3, 8, 40, 200]))
    if regions == 1:
        return Scene(GaussianField(*numbers, size=size))
    labels = random_labels(generator, size, regions)
    hard = RegionMap(labels)
    softness: float | dict[tuple[int, int], float] = float(generator.choice([0.0, 0.5, 1.3]))
    if generator.random() < 0.4:
        pairs = sorted(touching_pairs(hard.labels))
        softness = {pair: float(generator.choice([0.0, 0.25, 0.7, 2.0])) for pair in pairs}
    ids = hard.ids[torch.from_numpy(generator.integers(0, hard.num_regions, count))]
    return Scene(GaussianField(*numbers, ids, size=size), RegionMap(labels, softness))


def check_scenes(reader: Reader, seeds: range) -> None:
    for seed in seeds:
        assert check_same(reader, encode(random_scene(seed), quality=float(20 + seed % 5 * 15))), seed


class TestConformance:
    def test_golden(self, node: Node) -> None:
        assert check_same(node, GOLDEN.read_bytes())

    @pytest.mark.parametrize("seeds", [range(8), pytest.param(range(8, 212), marks=pytest.mark.slow)])
    def test_scenes(self, node: Node, seeds: range) -> None:
        check_scenes(node, seeds)

    @pytest.mark.parametrize("size", [(1, 550_000), (550, 1000)])
    def test_many_cells(self, node: Node, size: tuple[int, int]) -> None:
        count, generator = 34_500, torch.Generator().manual_seed(0)
        means = torch.rand(2, count, 2, generator=generator).prod(0) * torch.tensor(size[::-1])
        cholesky = torch.tensor([[1.0, 0.0, 1.0]]).expand(count, -1)
        strengths = torch.where(torch.arange(count) % 9 == 0, 0.3, 1.0)
        field = GaussianField(means, cholesky, strengths[:, None], size=size)
        assert check_same(node, encode(Scene(field), quality=10.0))

    @pytest.mark.slow
    @pytest.mark.parametrize("name", sorted(path.parent.name for path in MODELS.glob("*/scene.safetensors")))
    def test_zoo(self, node: Node, name: str) -> None:
        for quality in (30.0, 46.0, 70.0):
            assert check_same(node, encode(load(MODELS / name / "scene.safetensors"), quality=quality))


class TestDamage:
    @pytest.mark.parametrize(("count", "seed"), [(20, 0), pytest.param(2000, 1000, marks=pytest.mark.slow)])
    def test_damaged_files(self, node: Node, count: int, seed: int) -> None:
        generator = random.Random(seed)
        files = [encode(random_scene(seed + n), quality=40.0) for n in range(min(max(count // 20, 5), 40))]
        whole = 0
        for n in range(count):
            data, other = generator.sample(files, 2)
            content = (damaged_inside if n % 2 else damaged)(data, generator, other)
            whole += check_same(node, content)
        assert 0 < whole < count  # some are scenes still
        assert node.do("scene", files[0])["memory"] < MEMORY

    def test_what_is_wrong_is_named_and_whole_layers_are_kept(self, node: Node) -> None:
        data = GOLDEN.read_bytes()
        flipped = data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]
        answer, layers = node.do("scene", flipped), len(unpack(data)[2])
        assert f"the checksum of its layer {layers} is wrong" in answer["message"]
        assert answer["partial"]["layers"] == layers - 1
        for content, message in [
            (b"kcgs\2" + data[5:], "its version must be 1; got 2"),
            (b"GIF89a", 'it must start with "kcgs"; got "GIF8"'),
            (data[:9], "the file ends early"),
            (data + b"\0", f"the file must end after {len(data)} bytes; got {len(data) + 1}"),
            (codec.encode_labels(np.eye(9, dtype=np.uint8)), "it is a label map, no scene"),
        ]:
            answer = node.do("scene", content)
            assert answer["error"] == "DecodeError" and message in answer["message"]


class TestProgressive:
    @pytest.mark.parametrize("step", [1, 100])
    def test_layers_as_they_arrive(self, node: Node, step: int) -> None:
        data = GOLDEN.read_bytes()
        whole = node.do("scene", data)
        answer = node.do("stream", data, step=step)
        assert answer["layers"] == sorted(set(answer["layers"])) and answer["layers"][-1] == whole["layers"]
        assert step > 1 or answer["layers"] == [*range(1, whole["layers"] + 1)]
        whole.pop("memory")
        assert answer["last"] == whole

    def test_a_file_that_ends_early(self, node: Node) -> None:
        data = GOLDEN.read_bytes()[:-1]
        part = node.do("scene", data)
        last = node.do("stream", data, step=64)["last"]
        part.pop("memory")
        assert last["error"] == "DecodeError" and "the file ends early, with" in last["message"]
        assert last["partial"] == part and part["complete"] is False


class TestChromium:
    @pytest.fixture
    def page(self, browser: Browser, site: tuple[Path, str]) -> Page:
        browser.do("open", url=site[1])
        return Page(browser, site[0])

    def test_scenes(self, page: Page) -> None:
        assert check_same(page, GOLDEN.read_bytes())
        check_scenes(page, range(300, 303))

    def test_a_damaged_file(self, page: Page) -> None:
        assert not check_same(page, GOLDEN.read_bytes()[:-1] + b"?")

    def test_a_policy_without_webassembly_is_named(self, browser: Browser, site: tuple[Path, str]) -> None:
        policy = "<meta http-equiv=\"Content-Security-Policy\" content=\"script-src 'self' 'nonce-a'\">"
        page = PAGE.replace("<script", f'{policy}<script nonce="a"')
        (site[0] / "strict.html").write_text(page)
        (site[0] / "scene.kcgs").write_bytes(GOLDEN.read_bytes())
        browser.do("open", url=site[1] + "strict.html")
        answer = browser.evaluate("kcgs.describe('scene.kcgs')")
        assert answer["error"] == "DecodeError" and "'wasm-unsafe-eval'" in answer["message"]
