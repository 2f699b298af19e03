"""What strangers typed in their first hour, in order, in one folder: exit statuses, and a word of what is said."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from kcgs.cli import main
from kcgs.data import save_image, save_labels

# command, exit status, what standard output or standard error says
TRANSCRIPT = [
    ("fit photo.png -n 60 --iterations 30 -o scene.safetensors", 0, "psnr"),
    ("eval scene.safetensors photo.png", 0, "ef_psnr"),
    ("render scene.safetensors -o large.png --scale 4", 0, ""),
    ("render scene.safetensors -o odd.png --size 50x70", 0, ""),
    ("render scene.safetensors -o huge.png --scale 4000", 1, "memory"),
    ("info scene.safetensors", 0, "60"),
    ("info scene.safetensors --json", 0, '"num_gaussians": 60'),
    ("export scene.safetensors -o decoder.onnx", 0, ""),
    ("export scene.safetensors -o half.onnx --precision fp16", None, ""),  # refused where it would show
    ("encode scene.safetensors -o photo.kcgs", 0, ""),
    ("decode photo.kcgs -o decoded.png", 0, ""),
    ("decode photo.kcgs -o start.png --bytes 300", 0, ""),
    ("fit photo.png --target-bytes 600 --iterations 30 -o small.kcgs", 0, ""),
    ("fit photo.png --target-bytes 1 -o small.kcgs", 2, "target"),
    ("fit photo.png -n 200 --target-psnr 22 --iterations 30", 0, "target_psnr"),
    ("fit photo.png -n 5 --target-psnr 60 --iterations 30", 1, "--target-psnr 60 was not reached"),
    ("fit photo.png -n 60 --max-seconds 0.001 --regions none", 0, "seconds"),
    ("fit photo.png -n 1000000", 2, "at most"),
    ("fit photo.png other.png", 2, "other.png"),
    ("fit nowhere.png", 1, "no such file"),
    ("fit photo.png --regions nowhere.png", 1, "nowhere.png"),
    ("fit photo.png --regions mask.png -n 40 --iterations 30", 0, "regions"),
    ("fit photo.png --regions many.png -n 6 --iterations 30", 0, "merged"),
    ("fit photo.png --regions wide.png", 2, "size"),
    ("fit photo.png -o nowhere/scene.safetensors", 1, "folder"),
    ("fit photo.png -o scene.doc", 2, ".safetensors"),
    ("fit glass.png -n 20 --iterations 10", 0, "transparent"),
    ("fit moving.gif -n 20 --iterations 10", 0, "the first is read"),
    ("segment photo.png -o regions.png", 0, ""),
    ("segment photo.png -o regions.png --method slic", 0, ""),
    ("segment photo.png -o regions.png --method slic --option foo=3", 2, "foo"),
    ("segment --methods", 0, "slic"),
    ("fit-many photos -o scenes -n 30 --iterations 10 --workers 1 --regions none", 1, "broken.png"),
    ("fit-many photos -o scenes -n 30 --iterations 10 --workers 1 --regions none", 1, "fitted"),
    ("models", 0, "astronaut"),
    ("fitt photo.png", 2, "fitt"),
    ("fit photo.png --itterations 5", 2, "--iterations"),
    ("--version", 0, "kcgs"),
    ("--help", 0, "fit-many"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make what strangers bring: a photo, masks, odd files."""
    root = tmp_path_factory.mktemp("hour")
    generator = torch.Generator().manual_seed(3)
    coarse = torch.rand(1, 3, 6, 9, generator=generator)
    photo = torch.nn.functional.interpolate(coarse, (64, 96), mode="bicubic")[0].clamp(0, 1)
    labels = torch.zeros(64, 96, dtype=torch.long)
    labels[16:48, 30:70] = 1
    photo = torch.where(labels.bool(), 1 - photo, photo)
    (root / "photos").mkdir()
    for name in ("photo", "other", "photos/a", "photos/b"):
        save_image(root / f"{name}.png", photo)
    (root / "photos/broken.png").write_bytes((root / "photo.png").read_bytes()[:500])
    save_labels(root / "mask.png", labels)
    save_labels(root / "wide.png", torch.zeros(64, 128, dtype=torch.long))
    many = torch.arange(8)[:, None].repeat_interleave(8, 0) * 12 + torch.arange(12).repeat_interleave(8)
    save_labels(root / "many.png", many)
    pixels = (photo.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    glass = np.dstack([pixels, np.full((64, 96), 128, np.uint8)])
    Image.fromarray(glass).save(root / "glass.png")
    frames = [Image.fromarray(frame) for frame in (pixels, 255 - pixels)]
    frames[0].save(root / "moving.gif", save_all=True, append_images=frames[1:])
    return root


@pytest.mark.filterwarnings("always")  # the command shows them
@pytest.mark.usefixtures("clock")
def test_transcript(folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    wrong = []
    for command, status, words in TRANSCRIPT:
        monkeypatch.setattr(sys, "argv", ["kcgs", *shlex.split(command)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        said = "".join(capfd.readouterr())
        told = words.lower() in " ".join(said.lower().split())
        rough = "Traceback" in said or ".py:" in said or " nan" in said.lower()
        if not told or rough or (status is not None and code != status):
            wrong.append(f"kcgs {command}\n  exit {code}, not {status}; should say {words!r}:\n{said}")
    assert not wrong, "\n".join(wrong)
