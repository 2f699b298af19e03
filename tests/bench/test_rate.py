"""The benchmark of rates: its plan, its arithmetic, its files; fits are played by a stub, files are real."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

import kcgs.bench
from kcgs.bench.rate import codecs, points, report, tables, workshop
from kcgs.bench.rate.bjontegaard import delta
from kcgs.bench.rate.codecs import AVIF, CODECS, JPEG, WEBP, largest, open_file, present
from kcgs.bench.rate.experiment import run
from kcgs.bench.rate.gains import bits_a_gaussian, bounds, deltas, gains, lines, low_enough, pairs, shares
from kcgs.bench.rate.groups import steps
from kcgs.bench.rate.pictures import (
    DAVIS_CURVE,
    GROUPS,
    KODAK_CURVE,
    MAPS,
    MATCHED,
    PRECISION,
    QUICK_BYTES,
    SPEED,
    SYNTHETIC,
    TARGETS,
    Picture,
    missing,
    names,
    read,
)
from kcgs.bench.rate.points import (
    DECODE,
    FLOAT,
    KCGS,
    LABELS,
    LOSSLESS_WEBP,
    NO_REGIONS,
    Ask,
    Point,
    Store,
    codec_digest,
)
from kcgs.bench.rate.workshop import Workshop
from kcgs.codec import encode
from kcgs.data import save_image, save_labels
from kcgs.fit import FitConfig, FitResult, HistoryEntry
from kcgs.functional import RegionMap, ef_psnr, psnr
from kcgs.nn import GaussianField
from kcgs.rate import Compressed
from kcgs.scene import Scene


class Stub:
    """Plays the fits: random Gaussians, which the codec writes."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, int, bool]] = []
        self.stop_at: int | None = None

    def _ask(self, what: str, number: int, labels: Tensor | None) -> None:
        if len(self.asked) == self.stop_at:
            raise KeyboardInterrupt
        self.asked.append((what, number, labels is not None))

    def fit(self, image: Tensor, labels: Tensor | None, n: int, *, config: FitConfig) -> FitResult:
        self._ask("fit", n, labels)
        return self._result(image, labels, n, config)

    def fit_bytes(self, image: Tensor, labels: Tensor | None, most: int, *, config: FitConfig) -> Compressed:
        self._ask("fit_bytes", most, labels)
        result = self._result(image, labels, 30, config)
        return Compressed(encode(result.field, result.regions, target_bytes=most), result.field, result.regions, result)

    def compress(self, field: GaussianField, image: Tensor, regions: RegionMap | None, **how: Any) -> bytes:
        self._ask("compress", how.get("target_bytes", 0), None if regions is None else regions.labels)
        del how["iterations"]
        return encode(field, regions, **how)

    @staticmethod
    def _result(image: Tensor, labels: Tensor | None, n: int, config: FitConfig) -> FitResult:
        field = GaussianField.random(n, tuple(image.shape[1:]), sigma=8.0, regions=labels, seed=n)
        regions = None if labels is None else RegionMap.from_labels(labels)
        return FitResult(Scene(field, regions), [HistoryEntry(1, 0.1, 1.0, 10.0, 9.0, n)], "iterations", config)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    played = Stub()
    for module in (workshop, kcgs.bench.rate.groups):
        monkeypatch.setattr(module, "compress", played.compress)
    monkeypatch.setattr(workshop, "fit", played.fit)
    monkeypatch.setattr(workshop, "fit_bytes", played.fit_bytes)
    monkeypatch.setattr(workshop, "warm_up", lambda config: None)
    monkeypatch.setattr(workshop, "_warm_up", lambda config: None)
    return played


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Make folders with one small picture each."""
    root, picture = tmp_path / "data", read(MATCHED, SYNTHETIC, None)
    for tree in ("JPEGImages", "Annotations"):
        (root / "DAVIS" / tree / "480p/dog").mkdir(parents=True)
    save_image(root / "DAVIS/JPEGImages/480p/dog/00000.jpg", picture.image)
    save_labels(root / "DAVIS/Annotations/480p/dog/00000.png", picture.labels)
    (root / "kodak").mkdir()
    save_image(root / "kodak/kodim23.png", picture.image)
    for name in ("103", "7"):
        (root / "bsds" / name).mkdir(parents=True)
        save_labels(root / f"bsds/{name}/mask.png", picture.labels)
    return root


def point(codec: str = KCGS, size: int = 7_900, quality: float = 28.0, **values: Any) -> Point:
    fixed = Point(MATCHED, "dog", codec, 7_950, size, 8 * size / 4e5, "", quality, 0.9, quality + 1, 0.8, 2.0, 0.1)
    return fixed._replace(**values)


def section(text: str, title: str) -> str:
    return text.split(f"# {title}\n\n")[1].split("\n\n#")[0]


class TestCodecs:
    @pytest.mark.parametrize("codec", present())
    def test_largest_that_fits(self, codec: str) -> None:
        image = read(MATCHED, SYNTHETIC, None).image
        found = largest(codec, image, 1_500, quick=True)
        assert 750 < len(found.data) <= 1_500 and found.setting.startswith("quality ") and found.seconds > 0
        assert float(psnr(open_file(found.data), image)) > 22
        least = largest(codec, image, 10, quick=True)
        assert len(least.data) > 10 and least.setting.startswith("quality 0")

    def test_next_quality_is_too_large(self) -> None:
        image = read(MATCHED, SYNTHETIC, None).image
        found = largest(WEBP, image, 1_500)
        quality = int(found.setting.removeprefix("quality "))
        pixels = (image * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
        sizes = [
            len(codecs._encode("WEBP", pixels.tobytes(), pixels.shape[:2], q, (("method", 6),)).data)
            for q in (quality, quality + 1)
        ]
        assert sizes[0] == len(found.data) and sizes[1] > 1_500

    def test_search(self) -> None:
        for last in range(9):
            assert codecs._last(10, lambda place, last=last: place <= last) == last
            for place in range(10):
                assert codecs._walk(10, place, lambda place, last=last: place <= last) == last
        assert codecs._last(10, lambda place: False) == codecs._walk(10, 4, lambda place: False) == 0

    def test_qualities_of_avif(self) -> None:
        qualities = CODECS[AVIF].qualities
        assert len(qualities) == 64 and qualities[0] == 0 and qualities[-1] == 100

    def test_better_variant(self) -> None:
        image = read(MATCHED, SYNTHETIC, None).image
        best = largest(JPEG, image, 2_000)
        single = [codecs._largest(JPEG, v, image, 2_000, True, False) for v in CODECS[JPEG].variants]
        assert float(psnr(open_file(best.data), image)) == max(float(psnr(open_file(s.data), image)) for s in single)


class TestBjontegaard:
    curve = tuple((1000.0 * 2**i, 25.0 + 3 * i) for i in range(5))

    def test_half_the_bits(self) -> None:
        found = delta([(r / 2, q) for r, q in self.curve], self.curve)
        assert found.rate == pytest.approx(-50) and found.quality == pytest.approx(3) and found.overlap == 12

    def test_better_by_a_constant(self) -> None:
        found = delta([(r, q + 1) for r, q in self.curve], self.curve)
        assert found.quality == pytest.approx(1) and found.rate == pytest.approx(100 * (2 ** (-1 / 3) - 1))
        back = delta(self.curve, [(r, q + 1) for r, q in self.curve])
        assert back.quality == pytest.approx(-1) and back.rate == pytest.approx(100 * (2 ** (1 / 3) - 1))

    def test_curves_apart(self) -> None:
        found = delta([(r, q + 50) for r, q in self.curve], self.curve)
        assert math.isnan(found.rate) and found.overlap == 0 and found.quality == pytest.approx(50)
        found = delta([(r * 1e6, q) for r, q in self.curve], self.curve)
        assert math.isnan(found.quality) and found.rate > 0

    def test_files_that_are_no_part_of_the_curve(self) -> None:
        noise = [(1500.0, 24.0), (2000.0, 20.0), self.curve[0], (16000.0, 36.0)]
        assert delta([*self.curve, *noise], self.curve) == delta(self.curve, self.curve)
        assert math.isnan(delta(self.curve[:1], self.curve).rate)


class TestStore:
    def test_keeps(self, tmp_path: Path) -> None:
        store, ask = Store(tmp_path / "files"), Ask(MATCHED, "DAVIS/dog", KCGS, 100, False)
        assert store.read(ask, 1) is None
        store.write(ask, 1, point(), b"data")
        assert store.read(ask, 1) == point() and store.path(ask, 1, "file").read_bytes() == b"data"
        others = [ask._replace(asked=101), ask._replace(quick=True), ask._replace(codec=NO_REGIONS)]
        assert all(store.read(other, 1) is None for other in others) and store.read(ask, 2) is None

    def test_a_changed_codec_is_noticed(self, tmp_path: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
        shop = Workshop(Store(tmp_path), None, True)
        shop.other(MATCHED, SYNTHETIC, JPEG, 900)
        shop.fitted(MATCHED, SYNTHETIC, 900)
        monkeypatch.setattr(workshop, "codec_digest", lambda: "another")
        dry = Workshop(shop.store, None, True, makes=False)
        assert dry.fitted(MATCHED, SYNTHETIC, 900) is None
        assert dry.other(MATCHED, SYNTHETIC, JPEG, 900) is not None
        assert shop.fitted(MATCHED, SYNTHETIC, 900) is not None and len(stub.asked) == 2

    def test_digest(self) -> None:
        assert len(codec_digest()) == 64
        assert points.code_of("def f():\n    'Text.'\n    return 1") == points.code_of("def f():\n    return 1  # one")
        assert points.code_of("x = 'a'") != points.code_of("x = 'b'")


class TestPlan:
    def test_pictures(self, data: Path) -> None:
        assert names(MATCHED, data, False) == names(DAVIS_CURVE, data, False) == ["dog"]
        assert names(KODAK_CURVE, data, False) == ["kodim23"]
        assert names(MAPS, data, False) == ["DAVIS/dog", "bsds/7/mask", "bsds/103/mask"]
        assert missing(MATCHED, None) == "it needs a data folder"
        assert missing(MATCHED, data / "bsds") == "the data folder has no DAVIS"
        assert missing(KODAK_CURVE, data) is None

    def test_map_that_is_found(self, data: Path) -> None:
        found = read(KODAK_CURVE, "kodim23", data)
        assert found.seconds > 0 and found.labels.shape == found.image.shape[1:] and int(found.labels.max()) > 0
        assert read(DAVIS_CURVE, "dog", data).seconds == 0

    def test_groups(self, data: Path, tmp_path: Path) -> None:
        shop = Workshop(Store(tmp_path), data, False)
        assert [name for name, _ in steps(MATCHED, shop)] == ["dog", "dog, no regions"]
        assert len(list(steps(DAVIS_CURVE, shop))) == len(TARGETS)
        assert [name for name, _ in steps(PRECISION, shop)] == ["dog N = 1,250", "dog N = 7,500"]

    def test_what_may_be_asked(self, tmp_path: Path, data: Path) -> None:
        with pytest.raises(ValueError, match=r"data must be a folder with DAVIS, bsds or kodak in it"):
            run(tmp_path)
        with pytest.raises(ValueError, match=r"only must name groups of davis8k, .*; got 'maps,curve'"):
            run(tmp_path, data=data, only="maps,curve")
        with pytest.raises(ValueError, match=r"only asks for 'maps', but the data folder has no DAVIS"):
            run(tmp_path, data=data / "kodak", only="maps")


class TestMatched:
    def test_never_more_bytes(self, tmp_path: Path, stub: Stub) -> None:
        shop = Workshop(Store(tmp_path), None, True)
        found = [p for _, step in steps(MATCHED, shop) for p in step()]
        for rival in (*present(), NO_REGIONS):
            (pair,) = pairs(found, rival)
            assert pair.ours.codec == KCGS and (rival == NO_REGIONS or pair.ours.bytes <= pair.other.bytes)
        fits = [(most, labels) for what, most, labels in stub.asked if what == "fit_bytes"]
        avif = max((p.bytes for p in found if p.codec.startswith(AVIF)), default=QUICK_BYTES)
        assert fits == [(avif, True), (avif, False)]

    def test_pairs(self) -> None:
        files = [point(size=7_900, quality=28.5), point(size=7_000, quality=28.0), point(AVIF, 7_950, quality=28.25)]
        files += [point(JPEG, 7_500, quality=24.0), point(WEBP, 8_300, quality=27.0)]
        assert [pairs(files, codec)[0].ours.bytes for codec in (AVIF, JPEG, WEBP)] == [7_900, 7_000, 7_900]
        assert gains(pairs(files, AVIF), "psnr") == {"dog": 0.25}
        assert [low_enough(pairs(files, codec)[0]) for codec in (JPEG, WEBP)] == [True, False]
        assert pairs([point(size=7_900), point(AVIF, 7_000)], AVIF) == []

    def test_measures_the_file(self, tmp_path: Path, stub: Stub) -> None:
        shop = Workshop(Store(tmp_path), None, True)
        found = shop.fitted(MATCHED, SYNTHETIC, 600)
        assert found is not None and found.regions == 2
        ask = Ask(MATCHED, SYNTHETIC, KCGS, 600, True)
        data = shop.store.path(ask, shop._settings("fit_bytes"), "file").read_bytes()
        picture: Picture = read(MATCHED, SYNTHETIC, None)
        shown = workshop.draw(data)
        assert found.bytes == len(data) <= 600 and found.bpp == 8 * len(data) / picture.labels.numel()
        assert found.psnr == float(psnr(shown, picture.image))
        assert found.ef_psnr == float(ef_psnr(shown, picture.image, picture.labels))
        smaller = shop.rewritten(found, 500)
        assert smaller is not None and smaller.bytes <= 500 and smaller.encode_seconds > found.encode_seconds


class TestPrecision:
    def test_search(self, tmp_path: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
        shop = Workshop(Store(tmp_path), None, True)
        shop.quick = False
        scene = shop.scene(PRECISION, SYNTHETIC, 40)
        assert scene is not None and scene.codec == FLOAT and scene.num_gaussians == 40
        found = shop.rounded(scene)
        assert found is not None and found.bytes > 0 and scene.psnr - found.psnr <= workshop.MOST_LOSS
        ((_, _, bits),) = bits_a_gaussian([scene, found])
        assert bits == 8 * found.bytes / found.num_gaussians

    def test_step(self) -> None:
        assert workshop._step(14.5, -0.01) == -3.0 and workshop._step(14.5, 0.05) < 0 < workshop._step(14.5, 0.4)
        share = 10**0.04 - 1
        after = 10 * math.log10(1 + share * 10 ** (-workshop._step(14.5, 0.4) / 10))
        assert after == pytest.approx(workshop.MOST_LOSS - workshop._NEAR / 2)


class TestBounds:
    def test_matched(self) -> None:
        files = [point(quality=28.0), point(JPEG, quality=25.6), point(AVIF, quality=28.4)]
        files += [point(WEBP, 8_300, quality=27.0)]
        found = bounds(files)
        assert [(b.bound, b.met) for b in found] == [
            *((">= +2.50 dB", False), (">= +3.00 dB", False)),  # JPEG
            *((">= -0.50 dB", True), (">= +0.50 dB", False)),  # AVIF; WebP cannot go as low
        ]

    def test_others(self) -> None:
        files = [point(FLOAT, 0, 30.0, group=PRECISION, asked=100, num_gaussians=100)]
        files += [point(KCGS, 620, 29.9, group=PRECISION, asked=100, num_gaussians=100)]
        files += [point(LABELS, 40, group=MAPS), point(LOSSLESS_WEBP, 100, group=MAPS)]
        files += [point(DECODE, 40, group=SPEED, decode_seconds=0.2, num_gaussians=9)]
        assert [(b.measured, b.met) for b in bounds(files)] == [("49.6", False), ("40.0 %", True), ("0.2 s", False)]
        assert shares(files) == {"dog": 40.0}
        assert "| seconds, decode, 9 Gaussians | <= 0.1 s | 0.2 s | NO |" in tables.bounds_table(files)
        files[1] = files[1]._replace(bytes=500, psnr=29.8)  # few bits, at too great a loss
        assert not bounds(files)[0].met


class TestReport:
    def curves(self) -> list[Point]:
        sizes = (2_000, 4_000, 8_000)
        ours = [point(size=s, quality=22 + 3 * i, group=DAVIS_CURVE) for i, s in enumerate(sizes)]
        return ours + [p._replace(codec=AVIF, psnr=p.psnr + 1, ef_psnr=p.ef_psnr - 40) for p in ours]

    def test_losses_come_first(self, tmp_path: Path) -> None:
        files = [point(quality=28.0), point(AVIF, quality=28.4), point(JPEG, quality=25.0)]
        files += [point(image="cows"), point(AVIF, image="cows", quality=28.1, ms_ssim=0.95)]
        report.write(tmp_path, [*files, *self.curves()], ["maps: not chosen."], False)
        text = (tmp_path / "report.md").read_text()
        assert "nan" not in text and "- maps: not chosen." in text
        assert section(text, "Where kcgs loses").splitlines() == [
            "- davis8k, PSNR against AVIF: 2 of 2 frames lose: dog -0.40, cows -0.10",
            "- davis8k, EF-PSNR against AVIF: 2 of 2 frames lose: dog -0.40, cows -0.10",
            "- davis8k, MS-SSIM against AVIF: 1 of 2 frames lose: cows -0.050",
            "- davis-curve, BD-rate of PSNR against AVIF: more bits on dog +26 %",
        ]
        each = section(text, "Each frame at 7,950 bytes: against AVIF").splitlines()
        assert each[2].startswith("| dog | 7,900 | 7,900 | 28.40 | 29.40 | 28.00 | 29.00 | -0.40 |")
        assert "| at 7,950 bytes, mean EF-PSNR over AVIF, 2 frames | >= +0.50 dB | -0.25 dB | NO |" in text
        assert "no quality in common with AVIF, so no BD-rate: EF-PSNR on dog" in text
        assert {p.name for p in tmp_path.iterdir()} == {"report.md", "summary.csv", "matched.png", "davis-curve.png"}

    def test_summary(self) -> None:
        files = self.curves()
        assert deltas(files, DAVIS_CURVE, AVIF, "psnr")["dog"].quality == pytest.approx(-1)
        found = {(line.group, line.against, line.what): line.mean for line in lines(files)}
        assert found[DAVIS_CURVE, AVIF, "BD-PSNR"] == pytest.approx(-1)
        assert found[DAVIS_CURVE, AVIF, "BD-rate of PSNR"] == pytest.approx(100 * (2 ** (1 / 3) - 1))

    def test_nothing_to_show(self, tmp_path: Path) -> None:
        report.write(tmp_path, [], [], False)
        assert {p.name for p in tmp_path.iterdir()} == {"report.md", "summary.csv"}


class TestFiles:
    def test_quick_without_data_resumes(self, tmp_path: Path, stub: Stub) -> None:
        kcgs.bench.run("rate", tmp_path, quick=True)
        made = {"results.csv", "summary.csv", "report.md", "matched.png", "davis-curve.png", "files"}
        assert {p.name for p in tmp_path.iterdir()} == made
        with (tmp_path / "results.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["group"] for row in rows} == set(GROUPS) - {KODAK_CURVE}
        assert all(
            int(row["bytes"]) <= int(row["asked"]) for row in rows if row["group"] == MATCHED and row["regions"] == "2"
        )
        text = (tmp_path / "report.md").read_text()
        assert "kcgs bench rate --quick" in text and "## Bounds" not in text and "nan" not in text
        count = len(stub.asked)
        run(tmp_path, quick=True)
        assert len(stub.asked) == count

    def test_interrupted(self, tmp_path: Path, data: Path, stub: Stub, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(workshop, "largest", lambda *a, exact, quick: largest(*a, exact=exact, quick=True))
        stub.stop_at = 1
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "out", data=data, only="davis8k,maps")
        text = (tmp_path / "out/report.md").read_text()
        assert "- davis8k: stopped before its end, 0 of 2 steps are finished." in text
        assert "- precision: not chosen, 0 of 2 steps are finished." in text
        assert "- speed: the data folder has none of its pictures." in text
        stub.stop_at = None
        run(tmp_path / "out", data=data, only="davis8k,maps")
        assert "stopped before" not in (tmp_path / "out/report.md").read_text()


@pytest.mark.slow
def test_quick_with_real_fits(tmp_path: Path) -> None:
    run(tmp_path, quick=True)
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    ours = [row for row in rows if row["group"] == MATCHED and row["codec"] == KCGS]
    others = [row for row in rows if row["group"] == MATCHED and row["codec"] in present()]
    assert ours and all(float(o["psnr"]) > float(row["psnr"]) for o in ours for row in others)


@pytest.mark.slow
def test_maps_of_real_images(tmp_path: Path, data_root: Path) -> None:
    if not (data_root / "DAVIS").is_dir():
        pytest.skip(f"no DAVIS in {data_root}")
    run(tmp_path, data=data_root, only="maps")
    assert "| yes |" in section((tmp_path / "report.md").read_text(), "Bounds")
