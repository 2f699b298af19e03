"""Every scene of the zoo is what its manifest says, and renders what it was fitted to."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import kcgs
from benchmarks.core import images
from benchmarks.core.run import Options
from benchmarks.zoo import PLANS, make_zoo
from kcgs.functional import psnr
from kcgs.zoo import Entry, entries, find

MODELS = Path(kcgs.__file__).resolve().parent.parent / "models"
if not MODELS.is_dir():
    pytest.skip("the zoo comes with a checkout", allow_module_level=True)
ENTRIES = entries()


def test_zoo_is_whole_and_small() -> None:
    assert [entry.name for entry in ENTRIES] == list(PLANS)
    files = [path for path in MODELS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 5_000_000
    assert not list(MODELS.glob("*/*.py")), "models are data, never imported"


@pytest.mark.parametrize("entry", ENTRIES, ids=[entry.name for entry in ENTRIES])
def test_entry(entry: Entry) -> None:
    path = find(f"zoo:{entry.name}")
    assert path.stat().st_size == entry.bytes
    scene = kcgs.load(path)
    assert scene.num_gaussians == entry.num_gaussians
    image = images.load(PLANS[entry.name].image).image
    assert float(psnr(scene.render(), image)) == pytest.approx(entry.psnr, abs=0.02)
    folder = path.parent
    assert entry.licence in (folder / "card.md").read_text() and (folder / "preview.jpg").is_file()


class TestErrors:
    def test_no_zoo(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match="no zoo of fitted scenes"):
            entries(tmp_path)

    def test_unknown_name(self) -> None:
        with pytest.raises(ValueError, match="zoo entry must be one of chart-2x3"):
            find("zoo:nothing")

    @pytest.mark.parametrize("text", ["{", '{"entries": [{}]}', "[]"])
    def test_damaged_manifest(self, tmp_path: Path, text: str) -> None:
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(ValueError, match="must be a zoo's manifest"):
            entries(tmp_path)

    def test_changed_file(self, tmp_path: Path) -> None:
        entry = ENTRIES[0]
        (tmp_path / "manifest.json").write_text(json.dumps({"entries": [entry._asdict()]}))
        (tmp_path / entry.name).mkdir()
        (tmp_path / entry.scene).write_bytes(b"other")
        with pytest.raises(ValueError, match="missing or was changed"):
            find(entry.name, tmp_path)


def test_zoo_can_be_made(tmp_path: Path) -> None:
    make_zoo(Options(tmp_path, quick=True, only=("chart-2x3",)))
    (made,) = entries(tmp_path)
    assert made.name == "chart-2x3" and find("chart-2x3", tmp_path).is_file()
    with pytest.raises(ValueError, match="only must name scenes"):
        make_zoo(Options(tmp_path, only=("chart-3x2",)))
