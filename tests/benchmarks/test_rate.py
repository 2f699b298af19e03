"""The benchmark of rates: its plan, its arithmetic, its files; fits are played by a stub, files are real."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

import benchmarks
from benchmarks import _codecs, _rate_files, _rate_tables
from benchmarks._codecs import AVIF, AVIF_FAST, CODECS, JPEG, WEBP, largest, open_file, present
from benchmarks._rate_files import FLOAT, KCGS, MS_SSIM, NO_REGIONS, Ask, Files, Point, codec_digest
from benchmarks._rate_tables import (
    DAVIS_CURVE,
    KODAK,
    LABELS,
    LOSSLESS_WEBP,
    MAPS,
    MATCHED,
    PRECISION,
    bits_per_gaussian,
    deltas,
    gains,
    pairs,
    shares,
)  # fmt: skip
from benchmarks.core import images
from benchmarks.core import store as store_module
from benchmarks.core.options import Options
from benchmarks.core.report import Made, conclude
from benchmarks.core.rows import write_rows
from benchmarks.rate import GROUPS, QUICK_BYTES, QUICK_IMAGE, TARGETS, choose, names, report, steps
from kcgs.codec import encode
from kcgs.data import save_image, save_labels
from kcgs.fitting import FitConfig, FitResult, HistoryEntry
from kcgs.functional import RegionMap, ef_psnr, psnr
from kcgs.nn import GaussianField
from kcgs.rate import Compressed, FitBytesResult
from kcgs.scene import Scene


class Stub:
    """Plays the fits: random Gaussians, which the codec writes."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, int, bool]] = []
        self.recipes: list[FitConfig] = []  # of files
        self.stop_at: int | None = None

    def _ask(self, what: str, number: int, labels: Tensor | None) -> None:
        if len(self.asked) == self.stop_at:
            raise KeyboardInterrupt
        self.asked.append((what, number, labels is not None))

    def fit(self, image: Tensor, labels: Tensor | None, n: int, *, recipe: FitConfig, seed: int) -> FitResult:
        self._ask("fit", n, labels)
        return self._result(image, labels, n, recipe)

    def fit_bytes(self, image: Tensor, labels: Tensor | None, most: int, *, recipe: FitConfig) -> FitBytesResult:
        self._ask("fit_bytes", most, labels)
        self.recipes.append(recipe)
        result = self._result(image, labels, 30, recipe)
        return FitBytesResult(encode(result.scene, target_bytes=most), result.scene, result)

    def compress(self, scene: Scene, image: Tensor, *, iterations: int, **how: Any) -> Compressed:
        self._ask("compress", how.get("target_bytes", 0), None if scene.regions is None else scene.regions.labels)
        return Compressed(encode(scene, **how), scene)

    @staticmethod
    def _result(image: Tensor, labels: RegionMap | Tensor | None, n: int, config: FitConfig) -> FitResult:
        field = GaussianField.random(n, tuple(image.shape[1:]), sigma=8.0, regions=labels, seed=n)
        return FitResult(Scene(field, labels), [HistoryEntry(1, 0.1, 1.0, 10.0, 9.0, n)], "iterations", config)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    played = Stub()
    monkeypatch.setattr(_rate_files, "compress", played.compress)
    monkeypatch.setattr(store_module, "fit", played.fit)
    monkeypatch.setattr(store_module, "warm_up", lambda config: None)
    monkeypatch.setattr(_rate_files, "fit_bytes", played.fit_bytes)
    monkeypatch.setattr(_rate_files, "_warm_up", lambda config: None)
    return played


def sample() -> images.Sample:
    return images.load(QUICK_IMAGE, None, 2)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Make folders with one small picture each."""
    root, image = tmp_path / "data", sample()
    for tree in ("JPEGImages", "Annotations"):
        (root / "DAVIS" / tree / "480p/dog").mkdir(parents=True)
    save_image(root / "DAVIS/JPEGImages/480p/dog/00000.jpg", image.image)
    save_labels(root / "DAVIS/Annotations/480p/dog/00000.png", image.labels)
    (root / "kodak").mkdir()
    save_image(root / "kodak/kodim23.png", image.image)
    for name in ("103", "7"):
        (root / "bsds" / name).mkdir(parents=True)
        save_labels(root / f"bsds/{name}/mask.png", image.labels)
    return root


def point(codec: str = KCGS, size: int = 7_900, quality: float = 28.0, **values: Any) -> Point:
    fixed = Point(MATCHED, "dog", codec, 7_950, size, 8 * size / 4e5, "", quality, 0.9, quality + 1, 0.8, 2.0, 0.1)
    return fixed._replace(**values)


def section(text: str, title: str) -> str:
    return text.split(f"# {title}\n\n")[1].split("\n\n#")[0]


class TestCodecs:
    @pytest.mark.parametrize("codec", present())
    def test_largest_that_fits(self, codec: str) -> None:
        image = sample().image
        found = largest(codec, image, 1_500, quick=True)
        assert 750 < len(found.data) <= 1_500 and found.setting.startswith("quality ") and found.seconds > 0
        assert float(psnr(open_file(found.data), image)) > 22
        least = largest(codec, image, 10, quick=True)
        assert len(least.data) > 10 and least.setting.startswith("quality 0")

    def test_next_quality_is_too_large(self) -> None:
        image = sample().image
        found = largest(WEBP, image, 1_500)
        quality = int(found.setting.removeprefix("quality "))
        pixels = (image * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
        sizes = [
            len(_codecs._encode(WEBP, 0, False, pixels.tobytes(), (pixels.shape[1], pixels.shape[0]), q).data)
            for q in (quality, quality + 1)
        ]
        assert sizes[0] == len(found.data) and sizes[1] > 1_500

    def test_qualities_of_avif(self) -> None:
        qualities = CODECS[AVIF].qualities
        assert len(qualities) == 64 and qualities[0] == 0 and qualities[-1] == 100

    def test_better_variant(self, monkeypatch: pytest.MonkeyPatch) -> None:
        image = sample().image
        best = largest(JPEG, image, 2_000)
        for variant in CODECS[JPEG].variants:
            monkeypatch.setitem(CODECS, str(variant), CODECS[JPEG]._replace(variants=(variant,)))
        single = [largest(str(variant), image, 2_000) for variant in CODECS[JPEG].variants]
        assert float(psnr(open_file(best.data), image)) == max(float(psnr(open_file(s.data), image)) for s in single)


class TestFilesOnDisk:
    def test_keeps(self, tmp_path: Path, stub: Stub) -> None:
        files, ask = Files(tmp_path / "files", None, False), Ask(MATCHED, "DAVIS/dog", KCGS, 100)
        seen = point(ssimulacra2=50.0, butteraugli=1.0)
        dry = Files(files.folder, None, False, makes=False)
        assert dry.keep(ask, 1, lambda: (seen, b"data")) == [] and dry.missed == 1
        assert files.keep(ask, 1, lambda: (seen, b"data")) == [seen]
        assert dry.keep(ask, 1, lambda: (seen, b"data")) == [seen] and dry.missed == 1
        assert files.path(ask, 1, "file").read_bytes() == b"data"
        others = [(ask._replace(asked=101), 1), (ask._replace(codec=NO_REGIONS), 1), (ask, 2)]
        quick = Files(files.folder, None, True, makes=False)
        assert not any(dry.keep(*other, lambda: (seen, b"")) for other in others)
        assert quick.keep(ask, 1, lambda: (seen, b"")) == []

    def test_files_of_earlier_runs_are_looked_at(
        self, tmp_path: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        looks: list[tuple[Tensor, Tensor]] = []

        def look(record: Point, pair: Any) -> Point:
            looks.append(pair())
            return record._replace(ssimulacra2=42.0)

        files = Files(tmp_path, None, True)
        monkeypatch.setattr(_rate_files.eye, "look", lambda record, images: record)
        (made,) = files.other(MATCHED, QUICK_IMAGE, JPEG, 900)
        path = next(tmp_path.glob("*JPEG*.json"))
        path.write_text(json.dumps(made[:-2]))
        monkeypatch.setattr(_rate_files.eye, "look", look)
        (again,) = files.other(MATCHED, QUICK_IMAGE, JPEG, 900)
        assert json.dumps(again) == json.dumps(made._replace(ssimulacra2=42.0))
        assert float(psnr(*looks[0])) == made.psnr
        dry = Files(tmp_path, None, True, makes=False)
        assert dry.other(MATCHED, QUICK_IMAGE, JPEG, 900)[0].ssimulacra2 == 42.0 and len(looks) == 1

    def test_no_clock_counts_what_compiles_once(
        self, tmp_path: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        files, warmed = Files(tmp_path, None, False), list[FitConfig]()
        monkeypatch.setattr(_rate_files, "_warm_up", warmed.append)
        point = Point(MATCHED, QUICK_IMAGE, KCGS, 100, 0, 0.0, "")

        def make() -> tuple[Point, bytes]:
            assert warmed == [files.config]
            return point, b""

        assert len(files.keep(Ask(*point[:4]), "any way", make)) == 1

    def test_a_changed_codec_is_noticed(self, tmp_path: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
        files = Files(tmp_path, None, True)
        files.other(MATCHED, QUICK_IMAGE, JPEG, 900)
        files.fitted(MATCHED, QUICK_IMAGE, 900)
        assert len(codec_digest()) == 64
        monkeypatch.setattr(_rate_files, "codec_digest", lambda: "another")
        dry = Files(tmp_path, None, True, makes=False)
        assert dry.fitted(MATCHED, QUICK_IMAGE, 900) == []
        assert len(dry.other(MATCHED, QUICK_IMAGE, JPEG, 900)) == 1
        assert files.fitted(MATCHED, QUICK_IMAGE, 900) and len(stub.asked) == 2


class TestPlan:
    def test_images(self, data: Path) -> None:
        assert names(MATCHED, data, False) == names(DAVIS_CURVE, data, False) == ["dog"]
        assert names(KODAK, data, False) == ["kodim23"]
        assert names(MAPS, data, False) == ["DAVIS/dog", "bsds/7/mask", "bsds/103/mask"]
        assert names(MATCHED, None, False) == names(MATCHED, data / "bsds", False) == []

    def test_map_that_is_found(self, data: Path) -> None:
        files = Files(data, data, False)
        (image, labels), seconds = files.sample("kodim23")
        assert labels is not None and seconds > 0 and labels.shape == image.shape[1:] and int(labels.max()) > 0
        assert files.sample("dog")[1] == 0

    def test_groups(self, data: Path, tmp_path: Path) -> None:
        files = Files(tmp_path, data, False)
        expected = ["dog", *(f"dog, {codec}" for codec in (NO_REGIONS, MS_SSIM))]
        assert [name for name, _ in steps(MATCHED, files)] == expected
        assert len(list(steps(DAVIS_CURVE, files))) == len(TARGETS)
        assert [name for name, _ in steps(PRECISION, files)] == ["dog N = 1,250", "dog N = 7,500"]
        save_image(data / "kodak/kodim07.png", sample().image)
        planned = [name for name, _ in steps(KODAK, files)]
        assert planned[:3] == [f"kodim{p}, {NO_REGIONS}" for p in ("07 3,932", "23 3,932", "07 7,372")]
        assert (
            len(planned) == 30
            and planned[-1] == f"kodim23 39,321, {KCGS}"
            and planned[10] == f"kodim07 3,932, {AVIF_FAST}"
        )

    def test_what_may_be_asked(self, tmp_path: Path, data: Path) -> None:
        with pytest.raises(ValueError, match=r"data must be a folder with DAVIS, bsds or kodak in it"):
            choose(Options())
        with pytest.raises(ValueError, match=r"only must name groups with images, davis8k, .*; got 'maps,curve'"):
            choose(Options(data=data, only="maps,curve"))
        with pytest.raises(ValueError, match=r"only must name groups .*; got 'kodak,maps'"):
            choose(Options(quick=True, data=data, only="kodak,maps"))


class TestMatched:
    def test_never_more_bytes(self, tmp_path: Path, stub: Stub) -> None:
        files = Files(tmp_path, None, True)
        found = [p for _, step in steps(MATCHED, files) for p in step()]
        for rival in (*present(), NO_REGIONS):
            (pair,) = pairs(found, rival)
            assert pair.ours.codec == KCGS and (rival == NO_REGIONS or pair.ours.bytes <= pair.other.bytes)
        fits = [(most, labels) for what, most, labels in stub.asked if what == "fit_bytes"]
        avif = max((p.bytes for p in found if p.codec.startswith(AVIF)), default=QUICK_BYTES)
        own = next((p.bytes for p in found if p.codec == AVIF), QUICK_BYTES)
        assert fits == [(avif, True), (avif, False), (own, True)]
        assert [config.objective for config in stub.recipes] == ["psnr", "psnr", "ms-ssim"]

    def test_pairs(self) -> None:
        files = [point(size=7_900, quality=28.5), point(size=7_000, quality=28.0), point(AVIF, 7_950, quality=28.25)]
        files += [point(JPEG, 7_500, quality=24.0), point(WEBP, 8_300, quality=27.0)]
        assert [pairs(files, codec)[0].ours.bytes for codec in (AVIF, JPEG, WEBP)] == [7_900, 7_000, 7_900]
        gain = gains(pairs(files, AVIF), "psnr")
        assert gain is not None and gain.values == {"dog": 0.25}
        assert [pairs(files, codec)[0].is_low for codec in (JPEG, WEBP)] == [True, False]
        assert pairs([point(size=7_900), point(AVIF, 7_000)], AVIF) == []
        similar = [*files, point(MS_SSIM, 7_940, quality=27.5)]
        assert pairs(similar, AVIF) == pairs(files, AVIF) and pairs(similar, AVIF, MS_SSIM)[0].ours.psnr == 27.5
        assert pairs(similar, JPEG, MS_SSIM) == []
        assert "| kcgs, ms-ssim against AVIF | 1 |" in _rate_tables.matched_means(similar)
        lost = "- davis8k, kcgs, ms-ssim, PSNR against AVIF: 1 of 1 frames lose: dog -0.75"
        assert lost in _rate_tables.losses(similar)

    def test_measures_the_file(self, tmp_path: Path, stub: Stub) -> None:
        files = Files(tmp_path, None, True)
        (found,) = files.fitted(MATCHED, QUICK_IMAGE, 600)
        assert found.regions == 2
        ask = Ask(MATCHED, QUICK_IMAGE, KCGS, 600)
        data = files.path(ask, files.settings("fit_bytes"), "file").read_bytes()
        image, labels = sample()
        assert labels is not None
        shown = _rate_files.render(data)
        assert found.bytes == len(data) <= 600 and found.bpp == 8 * len(data) / labels.numel()
        assert found.psnr == float(psnr(shown, image))
        assert found.ef_psnr == float(ef_psnr(shown, image, labels)) and found.pairs_per_pixel > 0
        (smaller,) = files.rewritten(found, 500)
        assert smaller.bytes <= 500 and smaller.encode_seconds > found.encode_seconds


class TestPrecision:
    def test_search(self, tmp_path: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
        files = Files(tmp_path, None, True)
        files.quick = False
        (scene,) = files.scene(PRECISION, QUICK_IMAGE, 40)
        assert scene.codec == FLOAT and scene.num_gaussians == 40
        (found,) = files.rounded(scene)
        assert found.bytes > 0 and scene.psnr - found.psnr <= _rate_files.MOST_LOSS
        ((_, _, bits),) = bits_per_gaussian([scene, found])
        assert bits == 8 * found.bytes / found.num_gaussians

    def test_step(self) -> None:
        assert _rate_files.step(14.5, -0.01) == -3.0 and _rate_files.step(14.5, 0.05) < 0 < _rate_files.step(14.5, 0.4)
        share = 10**0.04 - 1
        after = 10 * math.log10(1 + share * 10 ** (-_rate_files.step(14.5, 0.4) / 10))
        assert after == pytest.approx(_rate_files.MOST_LOSS - _rate_files._NEAR / 2)


def test_precision_and_shares() -> None:
    files = [point(FLOAT, 0, 30.0, group=PRECISION, asked=100, num_gaussians=100)]
    files += [point(KCGS, 620, 29.9, group=PRECISION, asked=100, num_gaussians=100)]
    files += [point(LABELS, 40, group=MAPS), point(LOSSLESS_WEBP, 100, group=MAPS)]
    assert shares(files) == {"dog": 40.0} and "| 49.6 | 30.00 | 0.10 |" in _rate_tables.precision_table(files)


class TestReport:
    def curves(self) -> list[Point]:
        sizes = (2_000, 4_000, 8_000)
        ours = [point(size=s, quality=22 + 3 * i, group=DAVIS_CURVE) for i, s in enumerate(sizes)]
        return ours + [p._replace(codec=AVIF, psnr=p.psnr + 1, ef_psnr=p.ef_psnr - 40) for p in ours]

    def test_losses_come_first(self, tmp_path: Path) -> None:
        files = [point(quality=28.0), point(AVIF, quality=28.4), point(JPEG, quality=25.0)]
        files += [point(image="cows"), point(AVIF, image="cows", quality=28.1, ms_ssim=0.95)]
        write_rows(tmp_path / "results.csv", Point, [*files, *self.curves()])
        conclude(report, tmp_path, Made("python -m benchmarks rate", notes=("maps: not chosen.",)))
        text = (tmp_path / "report.md").read_text()
        assert "nan" not in text and "- maps: not chosen." in text
        assert section(text, "Where kcgs loses").splitlines() == [
            "- davis8k, PSNR against AVIF: 2 of 2 frames lose: dog -0.40, cows -0.10",
            "- davis8k, EF-PSNR against AVIF: 2 of 2 frames lose: dog -0.40, cows -0.10",
            "- davis8k, MS-SSIM against AVIF: 1 of 2 frames lose: cows -0.050",
            "- davis-curve, BD-rate of PSNR against AVIF: more bits on dog +26 %",
        ]
        assert {p.name for p in tmp_path.iterdir()} == {
            "results.csv",
            "made.json",
            "report.md",
            "davis-curve.png",
        }

    def test_curves(self) -> None:
        files = self.curves()
        assert deltas(files, DAVIS_CURVE, AVIF, "psnr")["dog"].quality == pytest.approx(-1)
        assert deltas(files, DAVIS_CURVE, AVIF, "psnr")["dog"].rate == pytest.approx(100 * (2 ** (1 / 3) - 1))
        (line,) = _rate_tables.bd_means(files, DAVIS_CURVE).splitlines()[2:]
        assert line.startswith("| AVIF | 1 | +26.0 |  |") and line.endswith("| -1.00 |  | +40.00 |  |")

    def test_kodak(self, tmp_path: Path) -> None:
        kinds = {NO_REGIONS: 30.0, KCGS: 29.5, AVIF_FAST: 31.0}
        files = [
            point(codec, most - 4, quality + place, group=KODAK, image=image, asked=most, pairs_per_pixel=10.0)
            for codec, quality in kinds.items()
            for place, most in enumerate(_rate_tables.RATES)
            for image in ("kodim07", "kodim23")
            if (codec, most, image) != (KCGS, 3_932, "kodim23")
        ]
        write_rows(tmp_path / "results.csv", Point, files)
        conclude(report, tmp_path, Made("python -m benchmarks rate"))
        text = (tmp_path / "report.md").read_text()
        assert "The data have 2 of Kodak's 24 photos" in text and "nan" not in text
        assert "| 0.08 | kcgs | 1 | 0.0786 | 29.50 | 0.9000 |  | +0.50 | 2 | 0.1 | 170 |" in text
        assert f"| {AVIF_FAST}, measured | 31.00 (2) |  |  | 32.00 (2) |  |" in text
        assert "| COIN++, as printed, all 24 photos |  |  |  | 25.14 |  |" in text
        assert f"- kodak, {NO_REGIONS}, BD-rate of PSNR against {AVIF_FAST}: more bits on kodim" in text

    def test_fast_avif(self) -> None:
        assert AVIF_FAST not in present() and CODECS[AVIF_FAST].settings["advanced"] == {"tune": "psnr"}
        assert Files(Path(), None, True).tuning == 10 and _rate_files.ITERATIONS == 600

    def test_what_the_eye_sees(self) -> None:
        ours, other = {"ssimulacra2": 50.0, "butteraugli": 2.0}, {"ssimulacra2": 53.0, "butteraugli": 1.5}
        files = [point(**ours), point(AVIF, **other), point(image="cows", **other)]
        files += [point(AVIF, image="cows", **ours)]
        table = _rate_tables.matched_means(files)
        assert "| SSIMULACRA2 gained | 95 % | won-lost | butteraugli gained |" in table.splitlines()[0]
        gained = {quality: gains(pairs(files, AVIF), quality) for quality in ours}
        assert [gain and gain.values for gain in gained.values()] == [
            {"dog": -3.0, "cows": 3.0},
            {"dog": -0.5, "cows": 0.5},  # a smaller distance is better
        ]
        assert "SSIMULACRA2 against AVIF: 1 of 2 frames lose: dog -3.0" in _rate_tables.losses(files)
        assert "butteraugli against AVIF: 1 of 2 frames lose: dog -0.50" in _rate_tables.losses(files)
        assert "SSIMULACRA2" not in _rate_tables.matched_means([point(), point(AVIF)])
        curves = [p._replace(ssimulacra2=2 * p.psnr, butteraugli=1 / p.psnr) for p in self.curves()]
        for quality in ours:
            assert deltas(curves, DAVIS_CURVE, AVIF, quality)["dog"].rate > 20

    def test_nothing_to_show(self, tmp_path: Path) -> None:
        conclude(report, tmp_path, Made("python -m benchmarks rate"))
        assert {p.name for p in tmp_path.iterdir()} == {"report.md", "made.json"}


class TestFiles:
    def test_quick_without_data_resumes(self, tmp_path: Path, stub: Stub) -> None:
        benchmarks.run("rate", tmp_path, quick=True)
        made = {"results.csv", "report.md", "davis-curve.png", "crops.png", "frames.jpg", "files", "made.json"}
        assert {p.name for p in tmp_path.iterdir()} == made
        with (tmp_path / "results.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["group"] for row in rows} == set(GROUPS) - {KODAK}
        assert all(
            int(row["bytes"]) <= int(row["asked"]) for row in rows if row["group"] == MATCHED and row["regions"] == "2"
        )
        text = (tmp_path / "report.md").read_text()
        assert "python -m benchmarks rate -o DIR --quick" in text and "nan" not in text
        count = len(stub.asked)
        benchmarks.run("rate", tmp_path, quick=True)
        assert len(stub.asked) == count

    def test_interrupted(self, tmp_path: Path, data: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(_rate_files, "largest", lambda *a, quick: largest(*a, quick=True))
        stub.stop_at = 1
        with pytest.raises(KeyboardInterrupt):
            benchmarks.run("rate", tmp_path / "out", data=data, only="davis8k,maps")
        text = (tmp_path / "out/report.md").read_text()
        assert "- davis8k: stopped before its end, 0 of 4 steps are finished." in text
        assert "- precision: not chosen, 0 of 2 steps are finished." in text
        stub.stop_at = None
        benchmarks.run("rate", tmp_path / "out", data=data, only="davis8k,maps")
        assert "stopped before" not in (tmp_path / "out/report.md").read_text()


@pytest.mark.slow
def test_quick_with_real_fits(tmp_path: Path) -> None:
    benchmarks.run("rate", tmp_path, quick=True)
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    ours = [row for row in rows if row["group"] == MATCHED and row["codec"] == KCGS]
    others = [row for row in rows if row["group"] == MATCHED and row["codec"] in present()]
    assert ours and all(float(o["psnr"]) > float(row["psnr"]) for o in ours for row in others)


@pytest.mark.slow
def test_maps_of_real_images(tmp_path: Path, data_root: Path) -> None:
    if not (data_root / "DAVIS").is_dir():
        pytest.skip(f"no DAVIS in {data_root}")
    benchmarks.run("rate", tmp_path, data=data_root, only="maps")
    assert "| DAVIS |" in section((tmp_path / "report.md").read_text(), "Label maps")
