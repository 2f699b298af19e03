"""Jobs that are kept, rows as CSV, comparisons, codecs, clocks."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.core.clocks import milliseconds, peak_megabytes, threads
from benchmarks.core.codecs import available_codecs, decode_file, largest_file
from benchmarks.core.compare import Comparison, Gain, differences
from benchmarks.core.images import load, load_mapped, names
from benchmarks.core.run import Job, Options, Page, Row, read_rows, run_experiment, write_rows
from benchmarks.core.scenes import fits_in, scene_of, size_of
from benchmarks.labels import CODECS, region_numbers
from benchmarks.pairs import read_answers
from benchmarks.rate import bd_rate
from kcgs.functional import psnr


def measure_square(image: str, number: int, folder: str) -> list[Row]:
    """Square a number, and leave a trace; of a negative one there is none."""
    if number < 0 and not Path(folder, "repaired").exists():
        raise ValueError("number must not be negative")
    trace = Path(folder, f"{number}.{os.getpid()}.{time.perf_counter_ns()}")
    trace.touch()
    return [{"image": image, "method": "square", "value": float(number**2), "threads": torch.get_num_threads()}]


def square_page(folder: Path, rows: list[Row]) -> Page:
    answer = f"Sum: {sum(row['value'] for row in rows):g}"
    return Page(answer, "a.png", "table", "", "Multiplied.", [{"method": "a - b", "value low": 1.5}])


class TestExperiment:
    def run(self, folder: Path, numbers: tuple[int, ...] = (1, 2, 3), **settings: Any) -> str:
        traces = folder / "traces"
        traces.mkdir(exist_ok=True)

        def jobs(options: Options) -> list[Job]:
            return [{"image": f"image{n}", "number": n, "folder": str(traces)} for n in numbers]

        options = Options(folder / "out", **settings)
        run_experiment("square", options, jobs, measure_square, square_page)
        return (folder / "out/report.md").read_text()

    def traces(self, folder: Path) -> list[str]:
        return sorted(path.name.partition(".")[0] for path in (folder / "traces").iterdir())

    def test_goes_on(self, tmp_path: Path) -> None:
        assert "Sum: 14" in self.run(tmp_path)
        assert {row["threads"] for row in read_rows(tmp_path / "out/results.csv")} == {1}
        report = self.run(tmp_path, (1, 2, 3, 4))
        assert self.traces(tmp_path) == ["1", "2", "3", "4"]
        assert "Sum: 30" in report and "## Losses\n\nNone." in report
        assert "- Command: `python -m benchmarks square -o DIR`" in report and "- Tree of kcgs/: `" in report
        assert (tmp_path / "out/differences.csv").read_text() == "method,value low\na - b,1.5\n"
        # names of images choose
        assert "Sum: 4" in self.run(tmp_path, only=("image2",))
        with pytest.raises(ValueError, match="only must name some of image1, image2, image3"):
            self.run(tmp_path, only=("image9",))

    def test_stopped(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="number must not be negative"):
            self.run(tmp_path, (1, 2, -3, 4))
        report = self.run(tmp_path, redraw=True)
        assert "Sum: 5" in report and "Stopped: 2 of 4 jobs are done." in report
        (tmp_path / "traces/repaired").touch()
        report = self.run(tmp_path, (1, 2, -3, 4))
        assert "Sum: 30" in report and "Stopped" not in report
        assert self.traces(tmp_path) == ["-3", "1", "2", "4", "repaired"]

    def test_redraw_measures_nothing(self, tmp_path: Path) -> None:
        report = self.run(tmp_path, quick=True)
        assert "--quick`" in report and "short form" in report
        assert self.run(tmp_path, (7,), redraw=True) == report

    def test_rows(self, tmp_path: Path) -> None:
        rows = [{"image": "3096", "n": 5, "psnr": 30.123456789, "note": "a, b"}, {"image": "b", "other": 1.5}]
        write_rows(tmp_path / "r.csv", rows)
        assert read_rows(tmp_path / "r.csv") == [{**rows[0], "psnr": 30.1235}, rows[1]]


def rows_of(ours: dict[str, float], other: dict[str, float]) -> list[Row]:
    pairs = (("ours", ours), ("other", other))
    return [{"image": i, "n": 5, "method": m, "psnr": v} for m, values in pairs for i, v in values.items()]


class TestCompare:
    comparison = Comparison("ours", "other")

    def test_paired(self) -> None:
        ours = {"a": 31.0, "b": 30.2, "c": 30.0, "d": 29.9, "e": 30.001, "alone": 50.0, "undefined": math.nan}
        rows = rows_of(ours, dict.fromkeys([*"abcde", "undefined"], 30.0))
        (gain,) = self.comparison.gains(rows, "psnr", ["n"]).values()
        assert gain.mean == pytest.approx(0.2202) and gain.num_wins == 2 and gain.losses == ["d"]
        assert gain.interval is not None and gain.interval[0] < 0 < gain.mean < gain.interval[1]
        (row,) = differences(rows, [self.comparison], ["psnr"], ["n"])
        assert row["method"] == "ours - other" and row["n"] == 5 and row["psnr"] == gain.mean
        assert (row["psnr low"], row["psnr high"]) == gain.interval

    def test_seeds_are_averaged_and_less_may_be_better(self) -> None:
        rows = [{"image": "a", "method": m, "bytes": v} for m, v in (("ours", 90), ("ours", 110), ("other", 120))]
        (gain,) = self.comparison.gains(rows, "bytes", []).values()
        assert gain.values == {"a": -20} and gain.num_wins == 1 and gain.losses == []
        assert Gain({"a": 1.0}, 0.0, 1).interval is None

    def test_interval_covers(self) -> None:
        """Of normal samples of six, about 95 % of the intervals hold the mean."""
        generator = torch.Generator().manual_seed(0)
        inside = 0
        for _ in range(60):
            values = torch.randn(6, generator=generator).tolist()
            low, high = Gain(dict(zip("abcdef", values, strict=True)), 0.0, 1).interval or (1.0, 0.0)
            inside += low <= 0 <= high
        assert inside >= 54

    def test_bd_rate(self) -> None:
        other = [{"bytes": b, "psnr": 10 * math.log10(b)} for b in (1_000, 2_000, 3_000, 4_000)]
        ours = [{**row, "bytes": 0.9 * row["bytes"]} for row in other]
        assert bd_rate(ours, other) == pytest.approx(-10.0) and bd_rate(other, ours) == pytest.approx(100 / 9)
        # a file that a smaller one beats changes nothing
        assert bd_rate([*ours, {"bytes": 5_000, "psnr": 20.0}], other) == pytest.approx(-10.0)
        assert bd_rate(ours[:1], other) is None
        assert bd_rate(ours, [{**row, "psnr": row["psnr"] + 50} for row in other]) is None


class TestImages:
    def test_without_data(self) -> None:
        for name, size in {"2x3": (200, 300), "pie": (300, 300), "disc": (320, 400)}.items():
            image, labels = load(name)
            assert labels is not None and image.shape == (3, *size) and labels.shape == size
        image, labels = load_mapped("astronaut", quick=True)
        assert image.shape == (3, 128, 128) and labels.shape == (128, 128) and load("astronaut").labels is None

    def test_with_data(self, data_root: Path) -> None:
        for group in ("davis", "kodak", "bsds"):
            name = names(data_root, group)[0]
            image, labels = load(name, str(data_root))
            assert (labels is not None) == (group == "davis") and image.shape[0] == 3


class TestCodecs:
    @pytest.mark.parametrize("codec", available_codecs())
    def test_largest_file(self, codec: str, astronaut: Tensor) -> None:
        image = astronaut[:, 128:192, 192:256].contiguous()
        files = [largest_file(codec, image, size) for size in (1_000, 2_000)]
        assert all(0.7 * most < len(file) <= most for file, most in zip(files, (1_000, 2_000), strict=True))
        assert psnr(decode_file(files[0]), image) < psnr(decode_file(files[1]), image)
        # no file is as small
        assert len(largest_file(codec, image, 10)) > 10

    @pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools
    @pytest.mark.parametrize("codec", CODECS)
    @pytest.mark.parametrize("most", [5, 400])
    def test_label_maps(self, codec: str, most: int) -> None:
        pytest.importorskip(CODECS[codec].package, reason="needs pip install 'kcgs[bench]'")
        if codec == "RLE" and most > 5:
            pytest.skip("a mask for each region")
        ids = torch.arange(most + 1).repeat_interleave(6_000 // (most + 1))
        index = region_numbers(ids[: len(ids) // 60 * 60].reshape(60, -1).numpy())
        decoded = CODECS[codec].decode(CODECS[codec].encode(index))
        assert (torch.as_tensor(decoded).reshape(index.shape).long() == torch.from_numpy(index).long()).all()


def test_answers_of_viewers(tmp_path: Path) -> None:
    ours, other = {"method": "kcgs"}, {"method": "AVIF"}
    pair = {"comparison": "1000 bytes", "image": "kodim01"}
    sides = [(ours, other), (other, ours), (other, other), (other, ours)]
    entries: list[Row] = [{"sheet": sheet, **pair, "A": a, "B": b} for sheet, (a, b) in enumerate(sides, 1)]
    text = "Sheets 1 to 4:\n01 B clearly: streaks, a face\n| 02 | slightly A | |\n**3**: no difference\nB 2, none 1\n"
    (tmp_path / "one.txt").write_text(text)
    assert [(row["sheet"], row["kind"], row["choice"], row["comment"]) for row in read_answers(tmp_path, entries)] == [
        (1, "pair", "other clearly", "streaks, a face"), (2, "swapped", "other slightly", ""),
        (3, "identical", "none", ""),
    ]  # fmt: skip


def test_clocks() -> None:
    calls: list[str] = []
    times = milliseconds({name: lambda name=name: calls.append(name) for name in "ab"}, 2)
    assert calls == ["a", "b"] * 3 and set(times) == {"a", "b"} and min(times.values()) >= 0
    with threads(1):
        assert torch.get_num_threads() == 1
    assert 150 < peak_megabytes(torch.ones, 50_000_000, warm_up=(10,)) < 300


def test_scenes() -> None:
    kinds = {"none": (1, 0.0), "hard": (6, 0.0), "soft": (6, 0.7)}
    for contours, (count, softness) in kinds.items():
        regions = scene_of(f"W3 {contours}").regions
        assert (1 if regions is None else regions.num_regions) == count
        assert regions is None or regions.softness == softness
    fitted = scene_of("rocket-1000")
    assert size_of(fitted, "native") == fitted.size and size_of(fitted, "3840 wide")[1] == 3840
    images = scene_of("batch")
    assert images.field.means.shape == (64, 256, 2) and images.render().shape == (64, 3, 128, 128)
    assert images.regions is not None and images.regions.labels.shape == (64, 128, 128)
    assert scene_of("batch none").regions is None
    assert scene_of("batch-16-64").field.means.shape == (16, 64, 2) and scene_of("batch-16-64").size == (64, 64)


def test_fits_of_the_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scenes").mkdir()
    scene = scene_of("W3 soft")
    scene.save(tmp_path / "scenes/dog-7500.safetensors")
    assert fits_in(tmp_path) == ["dog-7500"]
    assert "without dog-1250, kodim05-10000: DATA/scenes/NAME.safetensors is missing" in capsys.readouterr().err
    assert torch.equal(scene_of("dog-7500 soft", str(tmp_path)).render(), scene.render())
