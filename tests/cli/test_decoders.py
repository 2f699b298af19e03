"""export, view and models from the shell, and the page that export and view write."""

from __future__ import annotations

import base64
import hashlib
import json
import queue
import re
import threading
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene, load, save
from kcgs.codec import CodecError, decode, encode
from kcgs.data import load_image
from kcgs.page import scene_page
from kcgs.page.server import serve
from tests.cli.conftest import Kcgs


@pytest.fixture(autouse=True)
def _scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    labels = torch.zeros(32, 48, dtype=torch.long)
    labels[:, 20:] = 4
    regions = RegionMap(labels, 0.7)
    field = GaussianField.random(30, (32, 48), seed=0)
    field.assign_regions(regions)
    scene = Scene(field, regions, {"recipe": "best"})
    for suffix in ("safetensors", "kcgs"):
        save(f"scene.{suffix}", scene)


class TestExport:
    def test_interactive(self, kcgs: Kcgs) -> None:
        report = json.loads(kcgs("export", "scene.safetensors", "-o", "a.onnx", "--interactive", "--json").out)
        assert report["recipe"] == "best" and report["bytes"] == Path("a.onnx").stat().st_size
        names = [i.name for i in onnxruntime.InferenceSession("a.onnx").get_inputs()]
        assert names == ["size", "view", "visible"]

    def test_larger(self, kcgs: Kcgs) -> None:
        kcgs("export", "scene.safetensors", "-o", "a.onnx")
        (image,) = onnxruntime.InferenceSession("a.onnx").run(None, {"size": np.array([64, 96])})
        expected = load("scene.safetensors").render((64, 96))
        assert np.abs(image[0] - expected.numpy()).max() < 1e-3
        kcgs("render", "scene.safetensors", "-o", "large.png", "--scale", "2")
        assert (load_image("large.png") - expected).abs().max() <= 0.5 / 255 + 1e-6

    def test_page(self, kcgs: Kcgs) -> None:
        """Its behaviour in a browser is tested in tests/export/test_element.py."""
        arguments = ("export", "scene.safetensors", "-o", "a & b.html", "--json")
        report, file = json.loads(kcgs(*arguments).out), Path("a & b.html")
        page = file.read_text(encoding="utf-8")
        assert report["bytes"] == file.stat().st_size and report["num_gaussians"] == 30
        assert "<title>a &amp; b</title>" in page
        source = re.search(r'src="data:application/octet-stream;base64,([^"]+)"', page)
        assert source is not None
        data = base64.b64decode(source[1])
        assert len(data) == report["scene_bytes"]
        assert (decode(data).scene.render() - load("scene.safetensors").render()).abs().max() < 1 / 255

    def test_page_holds_a_compressed_file_as_it_is(self, kcgs: Kcgs) -> None:
        assert kcgs("export", "scene.kcgs", "-o", "a.html").code == 0
        data = base64.b64encode(Path("scene.kcgs").read_bytes()).decode()
        assert data in Path("a.html").read_text(encoding="utf-8")

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("scene.safetensors", "-o", "a.txt"), 2, "must end in .onnx or .html; got 'a.txt'"),
            (("scene.safetensors", "-o", "a.html", "--interactive"), 2, "'--interactive': must be left out with a"),
            (("truncated.safetensors", "-o", "a.onnx"), 1, "kcgs: "),
        ],
    )
    def test_errors(self, kcgs: Kcgs, arguments: tuple[str, ...], code: int, words: str) -> None:
        Path("truncated.safetensors").write_bytes(Path("scene.safetensors").read_bytes()[:300])
        run = kcgs("export", *arguments)
        assert run.code == code and words in run.err and not list(Path().glob("a.*"))


class TestPage:
    def test_the_policy_names_script_and_style(self) -> None:
        page = scene_page(Scene(GaussianField.random(5, (8, 9), seed=0)))
        policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
        assert policy is not None and "'unsafe" not in policy[1] and "default-src 'none'" in policy[1]
        allowed = dict(rule.split(" ", 1) for rule in policy[1].split("; "))
        for kind, tag in (("script", '<script type="module">(.*?)</script>'), ("style", "<style>(.*?)</style>")):
            texts = re.findall(tag, page, re.DOTALL)
            digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts]
            assert [f"'sha256-{digest}'" for digest in digests] == re.findall("'sha256-[^']*'", allowed[f"{kind}-src"])

    def test_channels(self) -> None:
        two = Scene(GaussianField.random(5, (8, 9), channels=2, seed=0))
        for scene in (two, encode(two)):
            with pytest.raises(ValueError, match="1, 3 or 4 channels"):
                scene_page(scene)

    def test_damaged_file(self) -> None:
        with pytest.raises(CodecError, match="must start with"):
            scene_page(b"no scene")


class TestView:
    def test_serves_a_page_on_loopback_alone(self) -> None:
        lines: queue.Queue[str] = queue.Queue()
        settings = {"browser": False, "say": lines.put}
        threading.Thread(target=serve, args=("<p>\u00e9</p>",), kwargs=settings, daemon=True).start()
        url = lines.get().removesuffix(" (Ctrl-C ends)")
        assert url.startswith("http://127.0.0.1:")
        response = urllib.request.urlopen(url)
        assert response.read().decode() == "<p>\u00e9</p>" and response.headers["Cache-Control"] == "no-store"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(url + "page.js")
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(url, headers={"Host": "elsewhere.example"}))

    def test_opens_the_page_of_a_scene(self, kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        urls: list[str] = []

        def interrupt(self: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("webbrowser.open", urls.append)
        monkeypatch.setattr("socketserver.BaseServer.serve_forever", interrupt)
        code, out, _ = kcgs("view", "scene.kcgs")
        assert (code, out) == (130, f"{urls[0]} (Ctrl-C ends)\n")


def test_models(kcgs: Kcgs) -> None:
    assert "chart-2x3" in json.loads(kcgs("models", "--json").out)
    assert "chart of six colours" in kcgs("models").out
