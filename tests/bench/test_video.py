"""The benchmark of clips: its plan, its arithmetic, what it keeps; in the quick form all of it is real."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import pytest
import torch

import kcgs.bench
from kcgs.bench import _video_runs, video
from kcgs.bench._video_runs import (
    AS_IT_IS,
    BETWEEN,
    BYTES,
    CLIP,
    MEAN,
    QUALITY,
    SPARSE,
    VARIANTS,
    Run,
    Runs,
    Shot,
    _changed_shares,
    flicker,
)  # fmt: skip
from kcgs.bench._video_tables import (
    GOALS,
    Results,
    against_codecs,
    beside_files,
    between,
    by_sequence,
    bytes_share,
    goals,
    means,
    parts,
    time_share,
)  # fmt: skip
from kcgs.bench.core import images
from kcgs.bench.core.jobs import Place
from kcgs.bench.core.options import Options
from kcgs.bench.video import FULL, QUICK, choose, first, second
from kcgs.data import save_image, save_labels
from kcgs.rate import fit_video
from kcgs.rate.video import carrying


def shot(frame: int, method: str = CLIP, sequence: str = "dog", **values: Any) -> Shot:
    fixed: dict[str, Any] = {"bytes": 1_000, "psnr": 28.0, "ef_psnr": 27.0, "flicker": 4.0, "seconds": 1.0}
    fixed |= {"flicker_inside": 3.0, "flicker_contours": 8.0, "is_key": int(frame == 0), "n": 1_250}
    return Shot(sequence=sequence, method=method, frame=frame, **{**fixed, **values})


@pytest.fixture
def results() -> Results:
    """A clip of a key frame and three more, two files of frames 0 and 1, and what belongs to them."""
    clip = [shot(0, bytes=7_000, psnr=29.0, seconds=10.0, flicker=math.nan), *(shot(frame) for frame in (1, 2, 3))]
    files = [shot(frame, QUALITY, bytes=7_000, psnr=28.2, ef_psnr=28.0, flicker=10.0) for frame in (0, 1)]
    others = [shot(1, BYTES, psnr=24.0), *(shot(frame, "x264", psnr=28.5, is_key=0) for frame in range(4))]
    others += [shot(1, BETWEEN, psnr=27.0), shot(1, MEAN, psnr=25.5)]
    return Results([*clip, *files, *others, shot(1, "no motion", psnr=27.0, bytes=1_500), shot(1, AS_IT_IS)])


class TestArithmetic:
    def test_bytes_are_of_all_frames_and_quality_of_all_but_the_first(self, results: Results) -> None:
        assert bytes_share(results, 1_250) == {"dog": 2_500 / 7_000}
        assert results.gains(1_250, CLIP, QUALITY, "psnr")["dog"] == pytest.approx(-0.2)
        assert results.gains(1_250, CLIP, "x264", "psnr") == {"dog": -0.5}
        assert results.shares(1_250, CLIP, QUALITY, "flicker") == {"dog": 0.4}
        assert time_share(results, 1_250) == {"dog": 0.1}

    def test_a_clip_of_key_frames_is_compared_too(self) -> None:
        clip = [shot(frame, psnr=28.0, is_key=1) for frame in range(3)]
        results = Results([*clip, *(shot(frame, "x264", psnr=30.0) for frame in range(3))])
        assert results.gains(1_250, CLIP, "x264", "psnr") == {"dog": -2.0} and time_share(results, 1_250) == {}
        assert "nan" not in by_sequence(results, 1_250) + goals(results)

    def test_goals(self, results: Results) -> None:
        lines = goals(results).splitlines()[2:]
        assert len(lines) == len(GOALS)
        met = [line.split(" | ")[4] for line in lines]
        assert met == ["**missed**", "met", "**missed**", "met", "met", "met", "met"]
        assert "dog 35.7 %" in lines[0] and "dog -1.00 dB" in lines[2] and "| 10.0 % | met" in lines[4]

    def test_tables(self, results: Results) -> None:
        assert "| 1,250 | x264 | PSNR | -0.50 | 0-1 | -0.50 |" in against_codecs(results)
        assert "| 1,250 | clip | 1 | 2,500 | 28.00 | 27.00 | 4 | 3 | 8 |" in means(results, {CLIP: None})
        assert "| dog | 1 | 7,000 | 1,000 | 10,000 | 28.25 |" in by_sequence(results, 1_250)
        assert "| dog | 36 % | -0.20 | -1.00 | +4.00 | +0.00 | 40 %" in beside_files(results, 1_250)
        assert "| 1,250 | dog | 27.00 | 25.50 |" in between(results)
        whole, part = parts(results)
        assert (
            whole.name == AS_IT_IS
            and whole.ours == whole.whole
            and part.name == "no motion"
            and part.ours["bytes"] == 1_500
            and part.whole["psnr"] == 28.0
        )

    def test_flicker_is_of_changes(self) -> None:
        labels = (torch.arange(40) >= 20).long().expand(10, 40).contiguous()
        photo = torch.rand(3, 10, 40, generator=torch.Generator().manual_seed(0)) / 2
        first, second = images.Sample(photo, labels), images.Sample(photo + 0.1, labels)
        biased = flicker(photo + 0.3, photo + 0.4, first, second)
        assert max(biased[part] for part in ("flicker", "flicker_inside", "flicker_contours")) < 1e-8
        jumps = torch.where(torch.arange(40) < 20, 0.0, 2 / 255)
        found = flicker(photo, photo + 0.1 + jumps, first, second)
        found.pop("flicker_followed")
        assert found == pytest.approx({"flicker": 2.0, "flicker_inside": 2.0, "flicker_contours": 2.0}, rel=1e-3)
        assert flicker(photo, photo + jumps, first, first)["flicker_followed"] == pytest.approx(2.0, rel=1e-2)


class TestRuns:
    def test_keeps_what_was_made(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        runs, made = Runs(tmp_path, None, True), list[Run]()
        run = Run("disc", 60, QUALITY, (0, 1))

        def files(self: Runs, run: Run, samples: Any) -> _video_runs.Made:
            made.append(run)
            return _video_runs.Made([b"ab", b"c"], [s.image for s in samples], [{"bytes": 2}, {"bytes": 1}])

        monkeypatch.setattr(Runs, "_files", files)
        assert runs.shots(run) is None
        for _ in range(2):
            assert runs.obtain([run], Place()) == []
        assert made == [run]
        found = runs.shots(run)
        assert found is not None and [s.bytes for s in found] == [2, 1] and found[0].psnr == math.inf
        assert math.isnan(found[0].flicker) and found[1].flicker == 0
        assert runs.shots(run._replace(frames=(0,))) is None
        assert Runs(tmp_path, None, False).shots(run) is None
        # files of single frames do not depend on how clips are made; clips do
        digests = {(): "all", ("rate/video", "codec/clips"): "stills"}
        paths = {}
        for name in ("one", "another"):
            monkeypatch.setattr(_video_runs, "codec_digest", lambda but=(), name=name: (digests[but], but or name))
            paths[name] = [runs._path(run._replace(method=method)) for method in (QUALITY, CLIP)]
        assert paths["one"][0] == paths["another"][0] and paths["one"][1] != paths["another"][1]

    def test_share_that_changed(self) -> None:
        x = torch.linspace(0, 1, 48).expand(3, 32, 48).contiguous()
        clip = fit_video([x, x, x.flip(2)], num_gaussians=20, iterations=20)
        key, same, other = _changed_shares(clip.to_bytes())
        assert math.isnan(key) and 0 <= same < 0.5
        assert len(clip.key_frames) > 1 or other > same

    def test_parts_are_taken_out_for_a_while(self) -> None:
        before = carrying._FREE
        for name, changes in VARIANTS.items():
            with _video_runs._changed(changes):
                assert (carrying._FREE == before) == ("iterations" not in name)
        assert before == carrying._FREE

    def test_frames_without_data(self, tmp_path: Path) -> None:
        one, two = Runs(tmp_path, None, True).samples("disc", (0, 3))
        assert one.image.shape == two.image.shape and one.labels is not None and two.labels is not None
        assert torch.equal(one.image[:, 3:, 6:], two.image[:, :-3, :-6])
        assert torch.equal(one.labels[3:, 6:], two.labels[:-3, :-6])


class TestPlan:
    def test_all(self) -> None:
        wanted = first(["dog", "train"], FULL)
        assert len(wanted) == len(set(wanted)) == 2 * (2 + 2 * 3 + 1) + len(VARIANTS)
        (sparse,) = (run for run in wanted if (run.sequence, run.method) == ("dog", SPARSE))
        assert sparse.frames == tuple(range(0, 23, 2)) and sparse.frames[-1] + 1 < FULL.frames
        assert str(sparse) == "dog, N = 1,250, clip of every second frame, frames 0 to 22"

    def test_bytes_of_the_clip(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        runs = Runs(tmp_path, None, True)
        assert second(runs, ["disc"], QUICK) == []
        monkeypatch.setattr(Runs, "shots", lambda self, run: [shot(0, bytes=701), shot(1, bytes=100)])
        monkeypatch.setattr(video, "is_there", lambda codec: codec == "av1")
        later = QUICK.pairs[0][1]
        assert second(runs, ["disc"], QUICK) == [
            Run("disc", 60, BYTES, (later,), 200), Run("disc", 60, "AV1", (0, 1, 2, 3), 801),
        ]  # fmt: skip

    def test_sequences(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        image, labels = images.load("disc", None, 8)
        assert labels is not None
        for name, count in (("dog", 3), ("cows", 1)):
            for tree in ("JPEGImages", "Annotations"):
                (tmp_path / tree / "480p" / name).mkdir(parents=True)
            for number in range(count):
                save_image(tmp_path / f"JPEGImages/480p/{name}/{number:05}.jpg", image)
                save_labels(tmp_path / f"Annotations/480p/{name}/{number:05}.png", labels)
        plan = FULL._replace(frames=3)
        assert choose(Options(data=tmp_path), plan) == ["dog"]
        with pytest.raises(ValueError, match=r"sequences must be of 3 frames or more, dog; got 'cows,dog'"):
            choose(Options(data=tmp_path, sequences="cows,dog"), plan)
        with pytest.raises(ValueError, match="data must have sequences of 24 frames or more"):
            choose(Options(data=tmp_path), FULL)
        with pytest.raises(ValueError, match="data must name a folder with DAVIS"):
            choose(Options(), FULL)


@pytest.mark.slow
def test_quick_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make, made = Runs.make, list[Run]()

    def stops(self: Runs, run: Run) -> None:
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(run)
        make(self, run)

    monkeypatch.setattr(Runs, "make", stops)
    with pytest.raises(KeyboardInterrupt):
        kcgs.bench.run("video", tmp_path, quick=True)
    assert "Stopped before its end" in (tmp_path / "report.md").read_text()
    monkeypatch.setattr(Runs, "make", make)
    kcgs.bench.run("video", tmp_path, quick=True)
    text = (tmp_path / "report.md").read_text()
    assert "Stopped" not in text and "nan" not in text.lower() and "kcgs bench video -o DIR --quick" in text
    for link in text.split("![](")[1:]:
        assert (tmp_path / link.split(")")[0]).is_file()
    with (tmp_path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {CLIP, QUALITY, BYTES, BETWEEN, *VARIANTS} <= {line["method"] for line in lines}
    kcgs.bench.run("video", tmp_path, redraw=True)
    assert (tmp_path / "report.md").read_text() == text
