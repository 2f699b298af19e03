"""Fits that experiments share: made once, kept, here or in worker processes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import kcgs.bench
from kcgs.bench import fits
from kcgs.bench.fits import HERE, Place, Spec, check_made, ensure, make_all
from kcgs.fit import FitConfig
from kcgs.functional import RegionMap

CONFIG = FitConfig.from_recipe("paper", iterations=5)


def spec(**changes: object) -> Spec:
    image = torch.linspace(0, 1, 32).expand(3, 24, 32).contiguous()
    return Spec(image, (image[0] > 0.5).long(), 6, CONFIG)._replace(**changes)  # type: ignore[arg-type]


class TestKey:
    def test_whatever_the_result_depends_on(self) -> None:
        labels = spec().regions
        assert isinstance(labels, torch.Tensor)
        others = [
            spec(image=spec().image.flip(2)),
            spec(regions=None),
            spec(regions=labels.flip(1)),
            spec(regions=RegionMap.from_labels(labels, 0.7)),
            spec(num_gaussians=7),
            spec(config=FitConfig.from_recipe("paper", iterations=6)),
            spec(seed=1),
            spec(band=labels),
        ]
        assert len({s.key() for s in [spec(), *others]}) == 9
        assert spec(name="other").key() == spec(regions=labels.int().long()).key() == spec().key()


class TestEnsure:
    def test_made_once(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = ensure([spec(), spec(seed=1), spec()], tmp_path / "runs")
        assert made[0] == made[2] != made[1] and len(list((tmp_path / "runs").iterdir())) == 2
        assert made[0].ef_psnr > 5 and made[0].history[-1].iteration == 5 and made[0].seconds > 0
        scene = made[0].scene()
        assert len(scene.field) == made[0].num_gaussians and scene.regions is not None
        assert made[0].core_seconds > 0
        monkeypatch.setattr(fits, "fit", None)
        assert ensure([spec(seed=1)], tmp_path / "runs") == [made[1]]

    def test_the_others_are_kept(self, tmp_path: Path) -> None:
        wrong = spec(regions=torch.zeros(3, 3, dtype=torch.long), name="too small a map")
        with pytest.raises(RuntimeError, match="fits failed, 1 of them: too small a map: ValueError: regions must be"):
            ensure([wrong, spec()], tmp_path)
        assert len(list(tmp_path.iterdir())) == 1


class TestPlace:
    def test_words(self) -> None:
        assert str(HERE) == "one at a time on one thread"
        assert str(Place(workers=3)) == "3 at a time on one thread each, engine local"
        assert "processors" in str(Place("ray"))

    def test_make_all(self) -> None:
        assert make_all(int, ["1", "x"], name=repr)[0].startswith("'x': ValueError")
        assert make_all(int, []) == []
        check_made([])

    def test_only_where_fits_may_run_side_by_side(self, tmp_path: Path) -> None:
        with pytest.raises(
            ValueError,
            match="engine and workers are for fit, maps, charts, .*; 'render' runs one after another",
        ):
            kcgs.bench.run("render", tmp_path / "out", workers=2)
        assert not (tmp_path / "out").exists()
