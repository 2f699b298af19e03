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
        code, out, err = kcgs("photos", *SETTINGS, "--workers", "1", "--json")
        assert code == 0, err
        report, table = json.loads(out), rows()
        assert [report[key] for key in ("images", "fitted", "failed", "missed")] == [3, 3, 0, 0]
        assert list(table) == ["a", "b", "c"]
        written = {f"{name}.{suffix}" for name in table for suffix in ("safetensors", "json")}
        assert {p.name for p in (files / "out").iterdir()} == {"results.csv", *written}
        for stem, row in table.items():
            scene = load(f"out/{stem}.safetensors")
            assert scene.metadata["recipe"] == "best" and int(row["num_gaussians"]) == scene.num_gaussians
            assert int(row["bytes"]) == (files / f"out/{stem}.safetensors").stat().st_size
            assert float(row["psnr"]) > 10
            assert row["error"] == row["ef_psnr"] == row["ms_ssim"] == ""
        assert report["mean_psnr"] == pytest.approx(sum(float(row["psnr"]) for row in table.values()) / 3)

    def test_missed_targets_are_said(self, files: Path, kcgs: Any) -> None:
        for fitted in (3, 0):  # a kept one too
            code, out, err = kcgs("photos", *SETTINGS, "--workers", "1", "--json", "--target-psnr", "80")
            assert code == 1 and [json.loads(out)[key] for key in ("missed", "fitted")] == [3, fitted]
            assert "--target-psnr was not reached by a.png, b.png, c.png" in err
        assert {row["target_reached"] for row in rows().values()} == {"False"}

    @pytest.mark.parametrize(
        "options", [("--suffix", ".kcgs", "-n", "12"), ("--target-bytes", "200")], ids=["suffix", "bytes"]
    )
    def test_compressed_files(self, files: Path, kcgs: Any, options: tuple[str, ...]) -> None:
        settings = (*options, "--iterations", "5", "--regions", "none", "-o", "out", "--workers", "1", "--json")
        code, out, err = kcgs("photos", *settings)
        assert code == 0 and json.loads(out)["fitted"] == 3, err
        for stem, row in rows().items():
            file = files / f"out/{stem}.kcgs"
            assert int(row["bytes"]) == file.stat().st_size <= 200
            assert load(file).num_gaussians == int(row["num_gaussians"])
        (files / "out/c.kcgs").unlink()
        code, out, err = kcgs("photos", *settings)
        assert code == 0 and json.loads(out)["fitted"] == 1, err

    @pytest.mark.parametrize("options", [("-n", "5"), ("--target-psnr", "20"), ("--suffix", ".safetensors")])
    def test_bytes_exclude(self, files: Path, kcgs: Any, options: tuple[str, ...]) -> None:
        code, _, err = kcgs("photos", "-o", "out", "--target-bytes", "200", *options)
        assert code == 2 and "--target-bytes" in err and not (files / "out").exists()

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
        assert json.loads(kcgs(*arguments)[1])["fitted"] == 0 and rows() == before
        assert [p.stat().st_mtime_ns for p in sorted(files.glob("out/*.safetensors"))] == times

        (files / "photos/b.png").write_bytes((files / "photos/a.png").read_bytes())
        assert json.loads(kcgs(*arguments)[1])["fitted"] == 1
        assert json.loads(kcgs(*arguments, "--seed", "1")[1])["fitted"] == 3

    @pytest.mark.parametrize("workers", ["1", "2"])
    def test_killed(self, files: Path, kcgs: Any, workers: str) -> None:
        """What fits the second image is killed, the command itself or a worker: the next call keeps the first."""
        code = (
            "import os, signal, sys\n"
            "from kcgs.cli import main, many_jobs\n"
            "fit_into = many_jobs.fit_into\n"
            "def fit_or_die(path, *arguments, **settings):\n"
            "    if path.stem == 'b':\n"
            "        while not (path.parent / 'a.json').exists(): pass\n"
            "        os.kill(os.getpid(), signal.SIGKILL)\n"
            "    return fit_into(path, *arguments, **settings)\n"
            "many_jobs.fit_into = fit_or_die\n"
            "if __name__ == '__main__': main()\n"
        )
        Path("script.py").write_text(code)
        arguments = ["photos", *SETTINGS, "--workers", workers, "--json"]
        command = [sys.executable, "script.py", "fit-many", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if workers == "1":
            assert done.returncode == -signal.SIGKILL
        else:
            assert done.returncode == 1
            assert done.stderr == (
                "kcgs: a worker process was killed, perhaps because memory ran out: the same command goes on where it "
                "stopped\n"
            )
        status, out, err = kcgs(*arguments)
        assert status == 0, err
        assert json.loads(out)["fitted"] <= 2
        assert len(rows()) == 3 and all(row["psnr"] for row in rows().values())

    def test_interrupted(self, files: Path, kcgs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        def press(path: Path, *arguments: Any, **settings: Any) -> Any:
            if path.stem == "b":
                raise KeyboardInterrupt
            return fit_into(path, *arguments, **settings)

        fit_into = many_jobs.fit_into
        monkeypatch.setattr(many_jobs, "fit_into", press)
        assert kcgs("photos", *SETTINGS, "--workers", "1") == (130, "", "")
        assert list(rows()) == ["a"]


class TestFailures:
    def test_one_image_stops_no_other(self, files: Path, kcgs: Any) -> None:
        code, out, err = kcgs("photos", "broken", *SETTINGS, "--workers", "1", "--json")
        assert code == 1
        report, table = json.loads(out), rows()
        assert [report[key] for key in ("images", "fitted", "failed")] == [4, 3, 1]
        assert err.startswith("kcgs: d.png: ") and "d.png" in table["d"]["error"]
        assert all(table[name]["psnr"] for name in "abc") and not table["d"]["psnr"]
        report = json.loads(kcgs("photos", "broken", *SETTINGS, "--workers", "1", "--json")[1])
        assert [report[key] for key in ("fitted", "failed")] == [0, 1]

    def test_mask_is_missing(self, files: Path, kcgs: Any) -> None:
        code, _, err = kcgs("photos", *SETTINGS, "--regions", "masks", "--workers", "1")
        assert code == 1 and rows()["a"]["ef_psnr"] and rows()["b"]["ef_psnr"]
        assert err.startswith("kcgs: c.png: ") and "/masks/c.*" in err

    def test_warnings_name_the_image(self, files: Path, kcgs: Any) -> None:
        code, _, err = kcgs("photos/a.png", *SETTINGS, "--regions", "masks", "-n", "1", "--keep-contours")
        assert code == 0 and "a.png: " in err and "region" in err

    def test_refused_before_the_work(self, files: Path, kcgs: Any) -> None:
        save_labels("masks/b.npy", torch.zeros(40, 60, dtype=torch.long))
        for arguments, status, message in (
            (("photos", "masks"), 2, "files must have different stems; got photos/a.png and masks/a.png"),
            (("photos", "--regions", "masks"), 2, "files must have different stems; got"),
            (("photos", "--regions", "mask"), 1, "mask"),
            (("photos", "--recipe", "worst"), 2, "recipe must be one of"),
            (("photos", "--engine", "slurm"), 2, "slurm"),
        ):
            code, _, err = kcgs(*SETTINGS, *arguments)
            assert code == status and message in " ".join(err.replace("│", " ").split())
        (files / "empty").mkdir()
        assert kcgs("empty", *SETTINGS)[0] == 2
        assert not (files / "out").exists()

    def test_which_files_of_a_folder_are_images(self, files: Path, kcgs: Any) -> None:
        frames = [Image.new("RGB", (20, 20), color) for color in ("red", "blue")]
        frames[0].save("masks/anim.gif", save_all=True, append_images=frames[1:])
        for name in ("notes.txt", "map.npy"):
            Path("masks", name).touch()
        code, out, err = kcgs("masks", *SETTINGS, "--workers", "1", "--json")
        assert code == 0 and json.loads(out)["fitted"] == 3, err
        assert err.startswith("anim.gif: ")

    def test_the_same_image_twice_is_one(self, files: Path, kcgs: Any) -> None:
        code, out, _ = kcgs("photos/a.png", "photos/a.png", *SETTINGS, "--workers", "1", "--json")
        assert code == 0 and json.loads(out)["images"] == 1
