"""export, view and models from the shell."""

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
from kcgs.cli import main
from kcgs.codec import CodecError, decode, encode
from kcgs.data import load_image
from kcgs.page import scene_page
from kcgs.page.server import serve


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["kcgs", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    labels = torch.zeros(32, 48, dtype=torch.long)
    labels[:, 20:] = 4
    regions = RegionMap.from_labels(labels, 0.7)
    field = GaussianField.random(30, (32, 48), seed=0)
    field.assign_regions(regions)
    save(tmp_path / "scene.safetensors", Scene(field, regions, {"recipe": "best"}))
    return tmp_path / "scene.safetensors"


class TestExport:
    def test_scene(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene: Path) -> None:
        out = scene.with_name("decoder.onnx")
        assert run(monkeypatch, "export", str(scene), "-o", str(out), "--interactive", "--json") == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["recipe"] == "best" and facts["bytes"] == out.stat().st_size
        names = [i.name for i in onnxruntime.InferenceSession(str(out)).get_inputs()]
        assert names == ["size", "view", "visible"]

    def test_crisp(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene: Path) -> None:
        out = scene.with_name("decoder.onnx")
        assert run(monkeypatch, "export", str(scene), "-o", str(out), "--contours", "crisp", "--json") == 0
        assert json.loads(capsys.readouterr().out)["contours"] == "crisp"
        (image,) = onnxruntime.InferenceSession(str(out)).run(None, {"size": np.array([64, 96])})
        assert np.abs(image[0] - load(scene).render((64, 96), "crisp").numpy()).max() < 1e-3
        png = scene.with_name("crisp.png")
        assert run(monkeypatch, "render", str(scene), "-o", str(png), "--scale", "2", "--contours", "crisp") == 0
        assert (load_image(png) - load(scene).render((64, 96), "crisp")).abs().max() <= 0.5 / 255 + 1e-6

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["-o", "decoder.txt"], "--output must end in .onnx or .html"),
            (["-o", "decoder.html", "--interactive"], "a page takes --contours only"),
        ],
    )
    def test_errors(
        self,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        scene: Path,
        arguments: list[str],
        words: str,
    ) -> None:
        monkeypatch.chdir(scene.parent)
        assert run(monkeypatch, "export", str(scene), *arguments) == 2
        assert words in capsys.readouterr().err
        assert not list(scene.parent.glob("decoder*"))

    def test_truncated_scene(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene: Path
    ) -> None:
        scene.write_bytes(scene.read_bytes()[:300])
        assert run(monkeypatch, "export", str(scene), "-o", str(scene.with_name("d.onnx"))) == 1
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


class TestZoo:
    def test_models_and_render(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        assert run(monkeypatch, "models", "--json") == 0
        listed = json.loads(capsys.readouterr().out)
        assert "chart-2x3" in listed
        assert run(monkeypatch, "render", "zoo:chart-2x3", "-o", str(tmp_path / "chart.png")) == 0
        assert (tmp_path / "chart.png").stat().st_size > 0
        assert run(monkeypatch, "render", "zoo:nothing", "-o", str(tmp_path / "chart.png")) == 2
        assert "zoo entry must be one of" in " ".join(capsys.readouterr().err.split())


class TestPage:
    """What it does in a browser is tested in tests/export/test_element.py."""

    def test_holds_the_scene(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene: Path
    ) -> None:
        out = scene.with_name("a & b.html")
        assert run(monkeypatch, "export", str(scene), "-o", str(out), "--contours", "crisp", "--json") == 0
        report = json.loads(capsys.readouterr().out)
        page = out.read_text(encoding="utf-8")
        assert report["bytes"] == out.stat().st_size and report["num_gaussians"] == 30
        assert "<title>a &amp; b</title>" in page and 'contours="crisp"' in page
        found = re.search(r'src="data:application/octet-stream;base64,([^"]+)"', page)
        assert found is not None
        data = base64.b64decode(found[1])
        assert len(data) == report["scene_bytes"]
        assert (decode(data).scene.render() - load(scene).render()).abs().max() < 1 / 255

    def test_keeps_a_file_as_it_is(self, monkeypatch: pytest.MonkeyPatch, scene: Path) -> None:
        file, out = scene.with_suffix(".kcgs"), scene.with_suffix(".html")
        save(file, load(scene))
        assert run(monkeypatch, "export", str(file), "-o", str(out)) == 0
        assert base64.b64encode(file.read_bytes()).decode() in out.read_text(encoding="utf-8")

    def test_the_policy_names_script_and_style(self) -> None:
        page = scene_page(Scene(GaussianField.random(5, (8, 9), seed=0)))
        policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
        assert policy is not None and "'unsafe" not in policy[1] and "default-src 'none'" in policy[1]
        for kind, tag in (("script", '<script type="module">(.*)</script>'), ("style", "<style>(.*)</style>")):
            text = re.search(tag, page, re.DOTALL)
            assert text is not None
            digest = base64.b64encode(hashlib.sha256(text[1].encode()).digest()).decode()
            assert f"{kind}-src 'sha256-{digest}'" in policy[1]

    def test_channels(self) -> None:
        two = Scene(GaussianField.random(5, (8, 9), channels=2, seed=0))
        for scene in (two, encode(two)):
            with pytest.raises(ValueError, match="1, 3 or 4 channels"):
                scene_page(scene)

    def test_a_damaged_file_is_no_page(self) -> None:
        with pytest.raises(CodecError, match="must start with"):
            scene_page(b"no scene")


class TestView:
    def test_serves_a_page_on_loopback_alone(self) -> None:
        said: queue.Queue[str] = queue.Queue()
        settings = {"browser": False, "say": said.put}
        threading.Thread(target=serve, args=("<p>\u00e9</p>",), kwargs=settings, daemon=True).start()
        url = said.get().removesuffix(" (Ctrl-C ends)")
        assert url.startswith("http://127.0.0.1:")
        answer = urllib.request.urlopen(url)
        assert answer.read().decode() == "<p>\u00e9</p>" and answer.headers["Cache-Control"] == "no-store"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(url + "page.js")
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(url, headers={"Host": "elsewhere.example"}))

    @pytest.mark.parametrize("suffix", [".safetensors", ".kcgs"])
    def test_opens_the_page_of_a_scene(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene: Path, suffix: str
    ) -> None:
        opened: list[str] = []

        def interrupt(self: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("webbrowser.open", opened.append)
        monkeypatch.setattr("socketserver.BaseServer.serve_forever", interrupt)
        file = scene.with_suffix(suffix)
        save(file, load(scene))
        assert run(monkeypatch, "view", str(file), "--contours", "crisp") == 130
        assert capsys.readouterr().out == f"{opened[0]} (Ctrl-C ends)\n"

    def test_a_decoder_is_no_scene(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(monkeypatch, "view", "decoder.onnx") == 2
        assert ".safetensors or .kcgs" in capsys.readouterr().err
