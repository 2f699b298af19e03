"""What strangers typed in their first hour, in order, in one folder: exit status, and a word of the output."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageFilter

from kcgs.data import save_image, save_labels
from tests.cli.conftest import Kcgs

# command, exit status, a word of standard output or standard error
TRANSCRIPT = [
    ("fit photo.png -n 30 --iterations 20 -o scene.safetensors", 0, "psnr"),
    ("eval scene.safetensors photo.png", 0, "ef_psnr"),
    ("render scene.safetensors -o odd.png --size 50x70", 0, "odd.png"),
    ("render scene.safetensors -o huge.png --scale 4000", 1, "memory"),
    ("info scene.safetensors --json", 0, '"num_gaussians": 30'),
    ("export scene.safetensors -o decoder.onnx", 0, "decoder.onnx"),
    ("export scene.safetensors -o half.onnx --precision fp16", 2, "precision"),
    ("encode scene.safetensors -o photo.kcgs", 0, "photo.kcgs"),
    ("decode photo.kcgs -o start.png --bytes 300", 0, "start.png"),
    ("fit photo.png --target-bytes 1 -o small.kcgs", 2, "target"),
    ("fit photo.png -n 60 --max-seconds 0.001 --regions none", 0, "seconds"),
    ("fit photo.png -n 60", 1, "photo.safetensors exists; --overwrite replaces it"),
    ("fit photo.png --regions many.png -n 6 --iterations 10 --overwrite", 0, "merged"),
    ("fit photo.png --regions wide.png --overwrite", 2, "--resize-regions"),
    ("fit photo.png --regions wide.png -n 20 --iterations 5 --overwrite --resize-regions", 0, "psnr"),
    ("eval scene.safetensors photo.png --regions wide.png", 2, "--resize-regions"),
    ("eval scene.safetensors photo.png --regions wide.png --resize-regions", 0, "psnr"),
    ("fit photo.png --regions soft.png -n 20 --iterations 5 --overwrite", 1, "--threshold 127"),
    ("fit photo.png --regions wide-soft.png -n 20 --overwrite --resize-regions", 1, "--threshold 127"),
    ("fit photo.png --regions soft.png --threshold 127 -n 20 --iterations 5 --overwrite", 0, "psnr"),
    ("eval scene.safetensors photo.png --regions soft.png --threshold 127", 0, "psnr"),
    ("encode soft.png --threshold 127 -o soft.kcgs", 0, "label map"),
    ("fit photo.png --threshold 127 --overwrite", 2, "left out with --regions auto"),
    ("fit glass.png -n 20 --iterations 5", 0, "transparent"),
    ("fit moving.gif -n 20 --iterations 5", 0, "the first is read"),
    ("segment photo.png -o regions.png --method slic --option foo=3", 2, "foo"),
    ("fit-many photos -o scenes -n 20 --iterations 5 --workers 1 --regions none", 1, "broken.png"),
    ("models", 0, "astronaut"),
    ("fit photo.png --itterations 5", 2, "--iterations"),
    ("--version", 0, "kcgs"),
    ("--help", 0, "fit-many"),
]


@pytest.fixture
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make what strangers bring: a photo, masks, odd files."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(3)
    coarse = torch.rand(1, 3, 4, 6, generator=generator)
    photo = torch.nn.functional.interpolate(coarse, (48, 64), mode="bicubic")[0].clamp(0, 1)
    labels = torch.zeros(48, 64, dtype=torch.long)
    labels[16:32, 30:50] = 1
    photo = torch.where(labels.bool(), 1 - photo, photo)
    Path("photos").mkdir()
    for name in ("photo", "photos/a"):
        save_image(f"{name}.png", photo)
    Path("photos/broken.png").write_bytes(Path("photo.png").read_bytes()[:500])
    save_labels("wide.png", torch.zeros(48, 128, dtype=torch.long))
    soft = Image.fromarray((labels * 255).byte().numpy()).filter(ImageFilter.GaussianBlur(1))
    soft.save("soft.png")
    soft.resize((128, 48)).save("wide-soft.png")
    save_labels("many.png", torch.arange(48).view(6, 8).repeat_interleave(8, 0).repeat_interleave(8, 1))
    pixels = (photo.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    Image.fromarray(np.dstack([pixels, np.full((48, 64), 128, np.uint8)])).save("glass.png")
    frames = [Image.fromarray(frame) for frame in (pixels, 255 - pixels)]
    frames[0].save("moving.gif", save_all=True, append_images=frames[1:])


@pytest.mark.filterwarnings("always")  # the command shows them
@pytest.mark.usefixtures("clock", "_files")
def test_transcript(kcgs: Kcgs) -> None:
    mistakes = []
    for command, status, words in TRANSCRIPT:
        code, out, err = kcgs(*shlex.split(command))
        has_words = words.lower() in (out + err).lower()
        is_rough = "Traceback" in err or ".py:" in err or " nan" in out.lower()
        if not has_words or is_rough or code != status:
            mistakes.append(f"kcgs {command}\n  exit {code}, not {status}; should have {words!r}:\n{out}{err}")
    assert not mistakes, "\n".join(mistakes)
