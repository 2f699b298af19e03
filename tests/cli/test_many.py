"""`kcgs fit-many` as a user or a script meets it."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from kcgs import load
from kcgs.cli import main, many_jobs
from kcgs.data import save_image, save_labels

SETTINGS = ("-n", "12", "--iterations", "5", "--regions", "none", "-o", "out")


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make three images, two masks, and a file that is no image."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(many_jobs, "_warm_up", lambda config, segments: None)
    for folder in ("photos", "masks", "broken"):
        (tmp_path / folder).mkdir()
    for index, name in enumerate(("a", "b", "c")):
        labels = torch.zeros(40, 60, dtype=torch.long)
        labels[10:30, 20 : 35 + 5 * index] = 1
        save_image(f"photos/{name}.png", torch.where(labels.bool(), torch.tensor([0.9, 0.4, 0.1])[:, None, None], 0.3))
        if name != "c":
            save_labels(f"masks/{name}.png", labels)
    (tmp_path / "broken/d.png").write_bytes(b"no image")
    return tmp_path


@pytest.fixture
def kcgs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["kcgs", "fit-many", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


def rows(path: str = "out/results.csv") -> dict[str, dict[str, str]]:
    with Path(path).open(newline="") as file:
        return {Path(row["image"]).stem: row for row in csv.DictReader(file)}


class TestTable:
    def test_scenes_rows_and_summary(self, files: Path, kcgs: Any) -> None:
        code, out, err = kcgs("photos/*.png", *SETTINGS, "--workers", "1", "--json", "--price-per-core-hour", "0.5")
        assert code == 0, err
        report, table = json.loads(out), rows()
        assert [report[key] for key in ("images", "fitted", "kept", "failed")] == [3, 3, 0, 0]
        assert list(table) == ["a", "b", "c"]
        assert {p.name for p in (files / "out").iterdir()} == {"results.csv", *(f"{n}.safetensors" for n in table)}
        for stem, row in table.items():
            scene = load(f"out/{stem}.safetensors")
            assert scene.metadata["fit"] == row["fit"] and scene.metadata["recipe"] == "best"
            assert int(row["num_gaussians"]) == scene.field.num_gaussians
            assert int(row["bytes"]) == (files / f"out/{stem}.safetensors").stat().st_size
            assert float(row["psnr"]) > 10 and float(row["core_seconds"]) > 0
            assert row["error"] == row["ef_psnr"] == row["ms_ssim"] == ""
        mean = sum(float(row["core_seconds"]) for row in table.values()) / 3
        assert report["core_hours_per_million"] == pytest.approx(mean * 1e6 / 3600)
        assert report["dollars_per_million"] == pytest.approx(mean * 1e6 / 3600 * 0.5)

    def test_missed_targets_are_said(self, files: Path, kcgs: Any) -> None:
        for _ in range(2):  # a kept one too
            code, out, err = kcgs("photos", *SETTINGS, "--workers", "1", "--json", "--target-psnr", "80")
            assert code == 1 and json.loads(out)["missed"] == 3
            assert "the target was missed by a.png, b.png, c.png" in err
        assert {row["target_reached"] for row in rows().values()} == {"False"}

    @pytest.mark.usefixtures("clock")
    def test_the_clock_is_for_each_image(self, files: Path, kcgs: Any) -> None:
        code, out, err = kcgs("photos", *SETTINGS, "--workers", "1", "--json", "--max-seconds", "0.001")
        assert code == 1 and json.loads(out)["missed"] == 3 and "missed by a.png" in err
        assert {row["stop_reason"] for row in rows().values()} == {"seconds"}
        code, out, err = kcgs("photos", *SETTINGS, "--workers", "1", "--json", "--max-seconds", "30")
        assert code == 0 and {row["target_reached"] for row in rows().values()} == {"True"}, err

    @pytest.mark.parametrize(
        "wanted", [("--suffix", ".kcgs", "-n", "12"), ("--target-bytes", "200")], ids=["suffix", "bytes"]
    )
    def test_compressed_files(self, files: Path, kcgs: Any, wanted: tuple[str, ...]) -> None:
        settings = (*wanted, "--iterations", "5", "--regions", "none", "-o", "out", "--workers", "1", "--json")
        code, out, err = kcgs("photos/*.png", *settings)
        assert code == 0 and json.loads(out)["fitted"] == 3, err
        for stem, row in rows().items():
            file = files / f"out/{stem}.kcgs"
            assert int(row["bytes"]) == file.stat().st_size <= 200 and load(file).num_gaussians == int(
                row["num_gaussians"]
            )
        (files / "out/b.kcgs").write_bytes((files / "out/a.kcgs").read_bytes())  # another fit's
        (files / "out/c.kcgs").unlink()
        code, out, err = kcgs("photos/*.png", *settings)
        assert code == 0 and [json.loads(out)[key] for key in ("fitted", "kept")] == [2, 1], err
        code, out, err = kcgs("photos/a.png", *settings, "--seed", "1")
        assert code == 0 and json.loads(out)["fitted"] == 1, err

    @pytest.mark.parametrize("given", [("-n", "5"), ("--target-psnr", "20"), ("--suffix", ".safetensors")])
    def test_bytes_exclude(self, files: Path, kcgs: Any, given: tuple[str, ...]) -> None:
        code, _, err = kcgs("photos/*.png", "-o", "out", "--target-bytes", "200", *given)
        assert code == 2 and "--target-bytes" in err and not (files / "out").exists()

    def test_no_price_is_invented(self, files: Path, kcgs: Any) -> None:
        code, out, _ = kcgs("photos/a.png", *SETTINGS)
        assert code == 0 and "core_hours_per_million" in out and "dollars" not in out

    def test_processes_write_the_same(self, files: Path, kcgs: Any) -> None:
        for workers, folder in (("1", "out"), ("2", "out2")):
            arguments = (*SETTINGS[:-1], folder, "--workers", workers)
            code, _, err = kcgs("photos/a.png", "photos/b.png", *arguments, "--regions", "masks")
            assert code == 0, err
        for name in ("a", "b"):
            one, two = ((files / folder / f"{name}.safetensors").read_bytes() for folder in ("out", "out2"))
            assert one == two
        assert all(row["ef_psnr"] for row in rows().values())


class TestResume:
    def test_what_is_there_is_kept(self, files: Path, kcgs: Any) -> None:
        arguments = ("photos", *SETTINGS, "--workers", "1", "--json")
        assert kcgs(*arguments)[0] == 0
        times, before = [p.stat().st_mtime_ns for p in sorted(files.glob("out/*.safetensors"))], rows()
        report = json.loads(kcgs(*arguments)[1])
        assert (report["fitted"], report["kept"]) == (0, 3) and rows() == before
        assert [p.stat().st_mtime_ns for p in sorted(files.glob("out/*.safetensors"))] == times
        assert report["core_hours_per_million"] > 0  # measured by the first call

        (files / "photos/b.png").write_bytes((files / "photos/a.png").read_bytes())
        report = json.loads(kcgs(*arguments)[1])
        assert (report["fitted"], report["kept"]) == (1, 2)
        report = json.loads(kcgs(*arguments, "--seed", "1")[1])
        assert (report["fitted"], report["kept"]) == (3, 0)

    def test_a_row_that_was_lost_is_measured_again(self, files: Path, kcgs: Any) -> None:
        arguments = ("photos", *SETTINGS, "--workers", "1", "--json")
        assert kcgs(*arguments)[0] == 0
        before = rows()
        lines = Path("out/results.csv").read_text().splitlines()
        Path("out/results.csv").write_text("\n".join([*lines[:2], lines[2][:70]]))  # killed while it wrote
        report = json.loads(kcgs(*arguments)[1])
        assert (report["fitted"], report["kept"]) == (0, 3)
        assert {k: r["psnr"] for k, r in rows().items()} == {k: r["psnr"] for k, r in before.items()}
        assert rows()["b"]["seconds"] == rows()["b"]["core_seconds"] == ""

    def test_damaged_scene_is_fitted_again(self, files: Path, kcgs: Any) -> None:
        arguments = ("photos/a.png", *SETTINGS, "--json")
        assert kcgs(*arguments)[0] == 0
        Path("out/a.safetensors").write_bytes(b"cut")
        assert json.loads(kcgs(*arguments)[1])["fitted"] == 1
        assert load("out/a.safetensors").num_gaussians > 0

    def test_killed(self, files: Path, kcgs: Any) -> None:
        """The command kills itself at its second image: the next call keeps the first."""
        code = (
            "import os, signal, sys\n"
            "from kcgs.cli import main, many_jobs\n"
            "fit_into, paths = many_jobs.fit_into, []\n"
            "def fit_or_die(path, *arguments, **settings):\n"
            "    paths.append(path)\n"
            "    if len(paths) == 2: os.kill(os.getpid(), signal.SIGKILL)\n"
            "    return fit_into(path, *arguments, **settings)\n"
            "many_jobs.fit_into, many_jobs._warm_up = fit_or_die, lambda *_: None\n"
            "main()\n"
        )
        arguments = ["photos", *SETTINGS, "--workers", "1", "--json"]
        done = subprocess.run([sys.executable, "-c", code, "fit-many", *arguments], check=False)
        assert done.returncode == -signal.SIGKILL
        status, out, err = kcgs(*arguments)
        assert status == 0, err
        report = json.loads(out)
        assert (report["kept"], report["fitted"]) == (1, 2)
        assert len(rows()) == 3 and all(row["psnr"] for row in rows().values())


class TestFailures:
    def test_one_image_stops_no_other(self, files: Path, kcgs: Any) -> None:
        code, out, err = kcgs("photos", "broken", *SETTINGS, "--workers", "1", "--json")
        assert code == 1
        report, table = json.loads(out), rows()
        assert [report[key] for key in ("images", "fitted", "failed")] == [4, 3, 1]
        assert err.startswith("kcgs: d.png: ") and "d.png" in table["d"]["error"]
        assert all(table[name]["psnr"] for name in "abc") and not table["d"]["psnr"]
        report = json.loads(kcgs("photos", "broken", *SETTINGS, "--workers", "1", "--json")[1])
        assert [report[key] for key in ("kept", "failed")] == [3, 1]

    def test_mask_is_missing(self, files: Path, kcgs: Any) -> None:
        save_labels("masks/b.npy", torch.zeros(40, 60, dtype=torch.long))
        code, _, err = kcgs("photos", *SETTINGS, "--regions", "masks", "--workers", "1")
        assert code == 1 and rows()["a"]["ef_psnr"]
        assert "masks must hold one mask c.*; found none" in err
        assert "masks must hold one mask b.*; found b.npy, b.png" in err

    def test_warnings_name_the_image(self, files: Path, kcgs: Any) -> None:
        code, _, err = kcgs("photos/a.png", *SETTINGS, "--regions", "masks", "-n", "1", "--keep-contours")
        assert code == 0 and "a.png: " in err and "region" in err

    def test_a_mask_that_is_lost_is_said(self, files: Path, kcgs: Any) -> None:
        y, x = torch.meshgrid(torch.arange(40), torch.arange(60), indexing="ij")
        save_image("photos/a.png", torch.stack([0.5 + 0.3 * torch.sin(0.11 * x + 0.07 * k * y) for k in range(3)]))
        save_labels("masks/a.png", (x // 6 + y // 6) % 2)
        code, _, err = kcgs("photos/a.png", *SETTINGS, "--regions", "masks", "--iterations", "60", "-n", "24")
        assert code == 0 and "a.png: regions: 2 regions became one; 1 merged: their contours do not help" in err

    def test_refused_before_the_work(self, files: Path, kcgs: Any) -> None:
        save_image("masks/d.jpg", torch.zeros(3, 20, 20))
        clashes = "; ".join(f"{files}/photos/{name}.png and {files}/masks/{name}.png" for name in "ab") + "\n"
        for arguments, wanted, message in (
            (("photos/nothing*",), 1, "PATTERN must name images; nothing found for 'photos/nothing*'"),
            (("photos", "masks"), 2, clashes),
            (("photos", "--regions", "mask"), 2, "--regions must be auto, none or a folder of masks; got 'mask'"),
            (("photos", "--recipe", "worst"), 2, "recipe must be one of"),
        ):
            code, _, err = kcgs(*SETTINGS, *arguments)
            assert code == wanted and message in err
        assert not (files / "out").exists()
        assert kcgs("photos", *SETTINGS, "--engine", "slurm")[0] == 2

    def test_which_files_of_a_folder_are_images(self, files: Path, kcgs: Any) -> None:
        frames = [Image.new("RGB", (20, 20), color) for color in ("red", "blue")]
        frames[0].save("masks/anim.gif", save_all=True, append_images=frames[1:])
        save_image("masks/dot.png", torch.rand(3, 1, 1))
        for name in ("notes.txt", "map.npy"):
            Path("masks", name).touch()
        code, out, err = kcgs("masks", *SETTINGS, "--workers", "1", "--json")
        assert code == 0 and json.loads(out)["fitted"] == 4 and rows()["dot"]["num_gaussians"] == "1", err
        assert err.startswith("kcgs: 2 files of other kinds skipped\nanim.gif: ")
        assert "dot.png: 1 Gaussians in place of 12: it has no more pixels\n" in err

    def test_the_same_image_twice_is_one(self, files: Path, kcgs: Any) -> None:
        code, out, _ = kcgs("photos/a.png", "photos/[ab].png", *SETTINGS, "--workers", "1", "--json")
        assert code == 0 and json.loads(out)["images"] == 2
