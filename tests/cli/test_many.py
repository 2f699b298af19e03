"""`kcgs fit-many` as a user or a script meets it."""

from __future__ import annotations

import csv
import itertools
import json
import pickle
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from kcgs import load
from kcgs.cli import many_jobs, many_shards
from kcgs.data import SceneDataset, save_image, save_labels
from kcgs.fitting import rank_gaussians
from tests.cli.conftest import Kcgs, Run

FIT = ("-n", "12", "--iterations", "3", "--workers", "1", "-o", "out")
SETTINGS = (*FIT, "--regions", "none")
ALONE = (*SETTINGS, "--batch", "1")


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make three images, masks of two, and a file that is no image."""
    monkeypatch.chdir(tmp_path)
    for folder in ("photos", "masks", "broken"):
        Path(folder).mkdir()
    for index, name in enumerate("abc"):
        labels = torch.zeros(24, 36, dtype=torch.long)
        labels[6:18, 12 : 20 + 3 * index] = 1
        save_image(f"photos/{name}.png", torch.where(labels.bool(), torch.tensor([0.9, 0.4, 0.1])[:, None, None], 0.3))
        if name != "c":
            save_labels(f"masks/{name}.png", labels)
    Path("broken/d.png").write_bytes(b"no image")


@pytest.fixture
def fit_many(kcgs: Kcgs) -> Kcgs:
    def run(*arguments: str) -> Run:
        return kcgs("fit-many", *arguments)

    return run


def rows() -> dict[str, dict[str, str]]:
    with Path("out/results.csv").open(newline="") as file:
        return {Path(row["image"]).stem: row for row in csv.DictReader(file)}


class TestTable:
    def test_scenes_rows_and_summary(self, fit_many: Kcgs) -> None:
        code, out, err = fit_many("photos", *SETTINGS, "--json")
        assert code == 0, err
        report, table = json.loads(out), rows()
        assert [report[key] for key in ("images", "fitted", "kept", "failed", "missed")] == [3, 3, 0, 0, 0]
        assert list(table) == ["a", "b", "c"]
        files = {f"{name}.{suffix}" for name in table for suffix in ("safetensors", "json")}
        assert {path.name for path in Path("out").iterdir()} == {"results.csv", *files}
        for stem, row in table.items():
            scene = load(f"out/{stem}.safetensors")
            assert scene.metadata["recipe"] == "best" and int(row["num_gaussians"]) == scene.num_gaussians
            assert int(row["bytes"]) == Path(f"out/{stem}.safetensors").stat().st_size
            assert float(row["psnr"]) > 10
            assert row["error"] == row["ef_psnr"] == row["ms_ssim"] == ""
        assert report["mean_psnr"] == pytest.approx(sum(float(row["psnr"]) for row in table.values()) / 3)

    def test_targets_that_are_missed(self, fit_many: Kcgs) -> None:
        for fitted, kept in ((2, 0), (0, 2)):
            code, out, err = fit_many("photos/a.png", "photos/b.png", *SETTINGS, "--json", "--target-psnr", "80")
            assert code == 1 and [json.loads(out)[key] for key in ("missed", "fitted", "kept")] == [2, fitted, kept]
            assert "--target-psnr was not reached by a.png, b.png" in err
        assert {row["target_reached"] for row in rows().values()} == {"False"}

    def test_compressed_files(self, fit_many: Kcgs) -> None:
        settings = ("--target-bytes", "200", "--iterations", "3", "--regions", "none", "-o", "out", "--json")
        assert json.loads(fit_many("photos/a.png", *settings).out)["fitted"] == 1
        file, row = Path("out/a.kcgs"), rows()["a"]
        assert int(row["bytes"]) == file.stat().st_size <= 200
        assert load(file).num_gaussians == int(row["num_gaussians"])
        file.unlink()
        assert json.loads(fit_many("photos/a.png", *settings).out)["fitted"] == 1


class TestResume:
    def test_a_file_of_the_user_is_kept(self, fit_many: Kcgs) -> None:
        """It has the name of the row of an image."""
        Path("out").mkdir()
        Path("out/a.json").write_text('{"caption": "a cup"}')
        code, _, err = fit_many("photos/a.png", *SETTINGS)
        assert code == 1 and "a.json exists, and was not written by kcgs fit-many; --overwrite replaces it\n" in err
        assert json.loads(Path("out/a.json").read_text()) == {"caption": "a cup"}
        assert fit_many("photos/a.png", *SETTINGS, "--overwrite").code == 0

    def test_scenes_are_kept(self, fit_many: Kcgs) -> None:
        arguments = ("photos/a.png", "photos/b.png", *SETTINGS, "--json")
        assert fit_many(*arguments).code == 0
        times, before = [path.stat().st_mtime_ns for path in sorted(Path("out").glob("*.safetensors"))], rows()
        assert json.loads(fit_many(*arguments).out)["fitted"] == 0 and rows() == before
        assert [path.stat().st_mtime_ns for path in sorted(Path("out").glob("*.safetensors"))] == times
        Path("photos/b.png").write_bytes(Path("photos/c.png").read_bytes())
        code, out, err = fit_many(*arguments)
        assert (code, json.loads(out)["failed"]) == (1, 1) and err.startswith("kcgs: b.png: ")
        assert "b.safetensors exists, made with other settings or changed since; --overwrite replaces it\n" in err
        before = rows()
        assert fit_many("photos/b.png", *SETTINGS).code == 1 and rows() == before  # all is refused
        assert json.loads(fit_many(*arguments, "--overwrite").out)["fitted"] == 1
        assert json.loads(fit_many(*arguments, "--overwrite", "--seed", "1").out)["fitted"] == 2

    def test_scene_without_its_row(self, fit_many: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        """A command that ended between scene and row goes on; a scene without any record is another's."""
        with monkeypatch.context() as patch:
            patch.setattr(many_jobs, "report_fit", lambda *_: signal.raise_signal(signal.SIGINT))
            assert fit_many("photos/a.png", *SETTINGS).code == 130
        assert Path("out/a.safetensors").is_file() and fit_many("photos/a.png", *SETTINGS).code == 0
        Path("out/a.json").unlink()
        assert fit_many("photos/a.png", *SETTINGS).code == 1

    @pytest.mark.parametrize(
        ("name", "damage"),
        [
            ("a.safetensors", lambda data: data[:500]),
            ("a.json", lambda data: data.replace(b'"psnr": ', b'"psnr": 9')),
        ],
    )
    def test_damage(self, fit_many: Kcgs, name: str, damage: Callable[[bytes], bytes]) -> None:
        assert fit_many("photos/a.png", *SETTINGS).code == 0
        scene, file = Path("out/a.safetensors").read_bytes(), Path("out", name)
        file.write_bytes(damage(file.read_bytes()))
        code, _, err = fit_many("photos/a.png", *SETTINGS)
        assert code == 1 and "a.safetensors exists, made with other settings or changed since; --overwrite" in err
        assert json.loads(fit_many("photos/a.png", *SETTINGS, "--overwrite", "--json").out)["fitted"] == 1
        assert Path("out/a.safetensors").read_bytes() == scene

    def test_killed_worker(self, fit_many: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        """Jobs and outcomes pass between processes; the next call keeps what was written."""
        message = "a worker process was killed"

        def run_one(function: Any, batches: Any, **_: Any) -> Iterator[Any]:
            run, batch = pickle.loads(pickle.dumps((function, batches[0])))
            yield 0, pickle.loads(pickle.dumps(run(batch)))
            raise RuntimeError(message)

        with monkeypatch.context() as patch:
            patch.setattr("kcgs.engine.run_jobs", run_one)
            assert fit_many("photos", *ALONE) == (1, "", f"kcgs: {message}\n")
        assert list(rows()) == ["a"]
        assert json.loads(fit_many("photos", *ALONE, "--json").out)["fitted"] == 2 and len(rows()) == 3

    def test_interrupted(self, fit_many: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt(path: Path, *arguments: Any, **settings: Any) -> Any:
            if path.stem == "b":
                signal.raise_signal(signal.SIGINT)
            return fit_and_save(path, *arguments, **settings)

        fit_and_save = many_jobs.fit_and_save
        monkeypatch.setattr(many_jobs, "fit_and_save", interrupt)
        message = "kcgs: interrupted: 1 of 3 images are done; the same command goes on where it stopped\n"
        assert fit_many("photos", *ALONE) == (130, "", message)
        assert list(rows()) == ["a"]


class TestFailures:
    def test_one_image_stops_no_other(self, fit_many: Kcgs) -> None:
        for fitted in (1, 0):
            code, out, err = fit_many("photos/a.png", "broken", *SETTINGS, "--json")
            assert (code, [json.loads(out)[key] for key in ("images", "fitted", "failed")]) == (1, [2, fitted, 1])
            assert err.startswith("kcgs: d.png: ") and "d.png" in rows()["d"]["error"]
            assert rows()["a"]["psnr"] and not rows()["d"]["psnr"]

    def test_missing_mask(self, fit_many: Kcgs) -> None:
        code, _, err = fit_many("photos", *FIT, "--regions", "masks")
        assert code == 1 and rows()["a"]["ef_psnr"] and rows()["b"]["ef_psnr"]
        assert err.startswith("kcgs: c.png: ") and "/masks/c.*" in err

    def test_warnings_name_the_image(self, fit_many: Kcgs) -> None:
        code, _, err = fit_many("photos/a.png", *FIT, "--regions", "masks", "-n", "1", "--keep-contours")
        assert code == 0 and err.startswith("warning: a.png: ") and "region" in err

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("photos", "masks"), "must have different stems; got photos/a.png and masks/a.png"),
            (("photos", "--regions", "masks"), "'--regions': must have different stems; got"),
            (("photos", "--device", "tpu"), "'--device': must be one that torch has"),
            (("photos", "--bounded", "--target-bytes", "90"), "'--bounded': must be False for a file of a size"),
            (("empty",), "must hold images"),
            (("nowhere",), "kcgs: No such file or directory: nowhere"),
            (("photos", "--batch", "some"), "must be auto, or a number of images"),
            (("photos", "--batch", "2", "--max-seconds", "90"), "left out with --max-seconds"),
            (("photos", "--batch", "2", "--target-psnr", "90"), "left out with --target-psnr"),
            (("photos", "--batch", "2", "--target-bytes", "90"), "left out with --target-bytes"),
            (("photos", "--shard", "9", "--suffix", ".kcgs"), "left out with --shard"),
            (("photos", "--suffix", ".kcgs", "--objective", "l1"), "must be l2 or ms-ssim for a file of a PSNR"),
            (("photos", "--suffix", ".safetensors", "--target-bytes", "90"), "must be left out with --target-bytes"),
        ],
    )
    def test_refused_before_the_work(self, fit_many: Kcgs, arguments: tuple[str, ...], words: str) -> None:
        save_labels("masks/b.npy", torch.zeros(24, 36, dtype=torch.long))
        Path("empty").mkdir()
        code, _, err = fit_many("--iterations", "1000000000", "-o", "out", *arguments)
        assert code == 2 and words in err and not Path("out").exists()

    def test_images_of_a_folder(self, fit_many: Kcgs) -> None:
        """An image that is named twice is one."""
        frames = [Image.new("RGB", (20, 20), color) for color in ("red", "blue")]
        frames[0].save("broken/anim.gif", save_all=True, append_images=frames[1:])
        Path("broken/d.png").rename("broken/notes.txt")
        Path("broken/map.npy").touch()
        code, out, err = fit_many("broken", "broken/anim.gif", *SETTINGS, "--json")
        assert code == 0 and json.loads(out)["images"] == 1, err
        assert err.startswith("warning: anim.gif: ")


class TestBatches:
    def test_the_files_of_a_batch_are_those_of_images_alone(self, fit_many: Kcgs) -> None:
        """Also with an image of another size, one that nobody can read, and one that lies on its side."""
        Image.new("RGB", (20, 30), "red").save("photos/tall.png")
        exif = Image.Exif()
        exif[274] = 6
        Image.open("photos/a.png").transpose(Image.Transpose.ROTATE_90).save("photos/turned.jpg", exif=exif)
        batches = ("1", "2", "auto")
        for batch in batches:
            code, _, err = fit_many("photos", "broken", *SETTINGS, "--iterations", "10", "-o", batch, "--batch", batch)
            assert code == 1 and err.startswith("kcgs: d.png: ")
        for stem in ("a", "b", "c", "tall", "turned"):
            assert len({Path(batch, f"{stem}.safetensors").read_bytes() for batch in batches}) == 1
        assert not Path("auto/d.safetensors").exists()

    def test_compressed_files(self, fit_many: Kcgs) -> None:
        for batch in ("1", "2"):
            arguments = ("photos/a.png", "photos/b.png", *SETTINGS, "--suffix", ".kcgs", "-o", batch, "--batch", batch)
            assert fit_many(*arguments).code == 0
        for name in ("a.kcgs", "b.kcgs"):
            assert Path("1", name).read_bytes() == Path("2", name).read_bytes()

    def test_an_error_of_the_fit_stops_one_image(self, fit_many: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(many_jobs, "fit_batch", lambda *_: 1 / 0)
        code, out, _ = fit_many("photos", *SETTINGS, "--json")
        assert code == 0 and json.loads(out)["fitted"] == 3

    def test_warnings_name_the_image(self, fit_many: Kcgs) -> None:
        code, _, err = fit_many("photos/a.png", "photos/b.png", *FIT, "--regions", "masks", "-n", "1")
        lines = err.splitlines()
        assert code == 0 and len(lines) == 2 and lines[0].startswith("warning: a.png: 1 of 2 regions were merged")


@contextmanager
def interrupted_at_the_second_batch(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    fit_batch, numbers = many_shards.fit_batch, itertools.count(1)

    def fit_or_stop(*values: Any) -> Any:
        return signal.raise_signal(signal.SIGINT) if next(numbers) == 2 else fit_batch(*values)

    with monkeypatch.context() as patch:
        patch.setattr(many_shards, "fit_batch", fit_or_stop)
        yield


class TestShards:
    def test_small_images_have_no_maps(self, fit_many: Kcgs) -> None:
        assert fit_many("photos", *FIT, "--shard", "4").code == 0
        scenes = load("out/00000.safetensors")
        assert scenes.num_images == 3 and scenes.regions is None and scenes.field.region_ids is None

    def test_shards_hold_what_files_hold(self, fit_many: Kcgs) -> None:
        arguments = ("photos", "broken", *SETTINGS, "--shard", "2", "--batch", "1", "--json")
        code, out, err = fit_many(*arguments)
        report = json.loads(out)
        assert (code, report["images"], report["fitted"], report["failed"]) == (1, 4, 3, 1) and "d.png" in err
        again = json.loads(fit_many(*arguments).out)
        assert [again[key] for key in ("fitted", "kept", "failed")] == [0, 3, 1]
        assert {path.name for path in Path("out").iterdir()} == {
            "00000.safetensors", "00001.safetensors", "results.csv"
        }  # fmt: skip
        assert fit_many("photos", *SETTINGS, "-o", "alone").code == 0
        dataset = SceneDataset("out")
        assert dataset.names == ["a.png", "b.png", "c.png"]
        for index, stem in enumerate("abc"):
            scene, alone = dataset[index], load(f"alone/{stem}.safetensors")
            assert torch.equal(scene.field.means, alone.field.means[rank_gaussians(alone.field)])
            assert float(rows()[stem]["psnr"]) == float(dataset.psnr[index])
        assert dataset.batch([0, 2]).means.shape == (2, 12, 2)

    def test_goes_on(self, fit_many: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        """An interrupted command loses one batch; a complete one does nothing."""
        arguments = ("photos", *SETTINGS, "--shard", "4", "--batch", "1", "--json")
        with interrupted_at_the_second_batch(monkeypatch):
            code, _, err = fit_many(*arguments)
        assert code == 130 and err.startswith("kcgs: interrupted: 1 of 3 images are done;"), err
        assert [str(path) for path in Path("out").rglob("*.safetensors")] == ["out/00000.parts/00000.safetensors"]
        code, out, err = fit_many(*arguments)
        assert code == 0 and [json.loads(out)[key] for key in ("fitted", "kept")] == [2, 1], err
        assert {path.name for path in Path("out").iterdir()} == {"00000.safetensors", "results.csv"}
        before = Path("out/00000.safetensors").read_bytes(), rows()
        code, out, _ = fit_many(*arguments)
        assert [json.loads(out)[key] for key in ("fitted", "kept")] == [0, 3]
        assert before == (Path("out/00000.safetensors").read_bytes(), rows())
        code, _, err = fit_many(*arguments, "--seed", "1")
        assert code == 1 and "00000.safetensors is damaged, or was made from other images or with other settings" in err
        assert rows() == before[1]
        assert json.loads(fit_many(*arguments, "--seed", "1", "--overwrite").out)["fitted"] == 3

    def test_goes_on_with_other_batches(self, fit_many: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        """What is left of the parts of an interrupted command is no part of the shard."""
        arguments = ("photos", *SETTINGS, "--shard", "4", "--json", "--batch")
        for size in ("1", "2"):
            with interrupted_at_the_second_batch(monkeypatch):
                assert fit_many(*arguments, size).code == 130
        code, out, err = fit_many(*arguments, "3")
        assert code == 0 and json.loads(out)["fitted"] == 3, err
        assert SceneDataset("out").names == ["a.png", "b.png", "c.png"]
        assert {path.name for path in Path("out").iterdir()} == {"00000.safetensors", "results.csv"}

    def test_parts_beside_a_complete_shard_are_removed(self, fit_many: Kcgs) -> None:
        """A command may be killed while it removes them."""
        arguments = ("photos", *SETTINGS, "--shard", "4", "--batch", "1", "--json")
        assert fit_many("photos/a.png", *SETTINGS, "-o", "other", "--shard", "4").code == 0
        assert fit_many(*arguments).code == 0
        shard = Path("out/00000.safetensors")
        before = shard.read_bytes()
        Path("out/00000.parts").mkdir()
        Path("out/00000.parts/00001.safetensors").write_bytes(Path("other/00000.safetensors").read_bytes())
        code, out, err = fit_many(*arguments)
        assert code == 0 and json.loads(out)["kept"] == 3, err
        assert shard.read_bytes() == before and not Path("out/00000.parts").exists()

    def test_maps_and_sizes(self, fit_many: Kcgs) -> None:
        """A shard has images of one size, each with its map."""
        Image.new("RGB", (20, 30), "red").save("photos/tall.png")
        for name, size in (("c", (24, 36)), ("tall", (30, 20))):  # a and b have masks
            save_labels(f"masks/{name}.png", (torch.arange(size[1]) > 9).long().expand(size))
        code, _, err = fit_many("photos", *FIT, "--regions", "masks", "--shard", "9")
        assert code == 0, err
        dataset = SceneDataset("out")
        assert dataset.names == ["a.png", "b.png", "c.png", "tall.png"]
        assert [dataset[k].size for k in range(4)] == [(24, 36)] * 3 + [(30, 20)]
        assert dataset[0].regions is not None

    def test_errors_of_masks_are_not_kept_with_resize_regions(self, fit_many: Kcgs) -> None:
        save_labels("masks/b.png", torch.zeros(4, 4, dtype=torch.long))
        arguments = ("photos/a.png", "photos/b.png", *FIT, "--regions", "masks", "--shard", "2", "--batch", "1")
        assert "b.png: regions must be one map of the image's size" in fit_many(*arguments).err
        assert "--overwrite replaces such shards" in fit_many(*arguments, "--resize-regions").err
        assert fit_many(*arguments, "--resize-regions", "--overwrite").code == 0
