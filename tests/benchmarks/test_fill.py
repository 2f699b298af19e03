"""The benchmark of filled holes: what an edit uncovers, its figures, and the quick form."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import benchmarks
from benchmarks.fill import FILLS, compare, edits
from kcgs import GaussianField, RegionMap, Scene


def scene(left: int = 6) -> Scene:
    """Flat grey, and a black square of 9 pixels on it, 30 x 60."""
    labels = torch.zeros(30, 60).long()
    labels[8:17, left : left + 9] = 5
    means, cholesky = torch.tensor([[30.0, 15.0]]), torch.tensor([[1e4, 0.0, 1e4]])
    field = GaussianField(means, cholesky, torch.full((1, 3), 0.5), torch.tensor([0]), size=(30, 60))
    return Scene(field, RegionMap.from_labels(labels))


@pytest.mark.parametrize(("left", "step"), [(6, 3), (50, -3)])
def test_objects_are_moved_away_from_the_nearer_border(left: int, step: int) -> None:
    (_, _, hole, all_of_it), (_, apply, both, uncovered) = edits(scene(left))
    assert torch.equal(hole, all_of_it) and int(hole.sum()) == 81
    # 3 columns are left, of which 2 are the contour's
    assert int(uncovered.sum()) == 9 and int(both.sum()) == 108
    assert uncovered[:, left if step > 0 else left + 8].any()
    assert torch.equal(apply(fill=None).regions.labels == 5, hole.roll(step, 1))


def test_one_region_has_no_object() -> None:
    regions = RegionMap.from_labels(torch.zeros(8, 8).long())
    assert edits(Scene(GaussianField.random(4, (8, 8), regions=regions, seed=0), regions)) == []


def test_flat_ground_is_flat() -> None:
    found, images = compare("flat", scene(), *edits(scene())[0])
    assert [r.fill for r in found] == list(FILLS) and list(images) == ["scene", "before", "filled"]
    for r in found:
        assert r.low == pytest.approx(0.5, abs=0.01) and r.high == pytest.approx(0.5, abs=0.01)
        assert r.changed == 0 and r.pixels == 81
    assert images["filled"].shape == (3, 30, 60)


def test_quick_form(tmp_path: Path) -> None:
    benchmarks.run("fill", tmp_path, quick=True)
    text = (tmp_path / "report.md").read_text()
    assert "## delete" in text and "## move" in text and "| disc |" in text and "nan" not in text
    assert (tmp_path / "delete.jpg").is_file() and (tmp_path / "move.jpg").is_file()
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 5
    before = text
    benchmarks.run("fill", tmp_path, quick=True, redraw=True)
    assert (tmp_path / "report.md").read_text() == before
