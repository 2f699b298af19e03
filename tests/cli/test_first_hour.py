"""What strangers typed in their first hour, in order, in one folder: exit status, and a word of the output."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from PIL import Image, ImageFilter

from kcgs.data import save_labels
from tests.cli.conftest import Kcgs

# command, exit status, a word of standard output or standard error; photo.png has 40 x 60 pixels
TRANSCRIPT = [
    ("fit photo.png -n 30 --iterations 20 --regions mask.png", 0, "psnr"),
    ("fit photo.png -n 60", 1, "photo.safetensors exists; --overwrite replaces it"),
    ("fit photo.png --regions many.png -n 6 --iterations 10 --overwrite", 0, "merged"),
    ("fit photo.png --regions wide.png --overwrite", 2, "--resize-regions"),
    ("fit photo.png --regions wide.png -n 20 --iterations 5 --overwrite --resize-regions", 0, "psnr"),
    ("eval photo.safetensors photo.png --regions wide.png", 2, "--resize-regions"),
    ("eval photo.safetensors photo.png --regions wide.png --resize-regions", 0, "ef_psnr"),
    ("fit photo.png --regions soft.png -n 20 --iterations 5 --overwrite", 1, "--threshold 127"),
    ("fit photo.png --regions soft.png --threshold 127 -n 20 --iterations 5 --overwrite", 0, "psnr"),
    ("eval photo.safetensors photo.png --regions soft.png --threshold 127", 0, "psnr"),
    ("encode soft.png --threshold 127 -o soft.kcgs", 0, "label map"),
    ("fit photo.png --threshold 127 --overwrite", 2, "left out with --regions auto"),
    ("export photo.safetensors -o half.onnx --precision fp16", 2, "precision"),
    ("fit photo.png --target-bytes 1", 2, "target"),
    ("fit photo.png --itterations 5", 2, "--iterations"),
    ("--version", 0, "kcgs"),
    ("--help", 0, "fit-many"),
]


@pytest.mark.filterwarnings("always")  # the command shows them
@pytest.mark.usefixtures("photo")
def test_transcript(kcgs: Kcgs) -> None:
    save_labels("wide.png", (torch.arange(120) > 50).long().expand(40, 120))
    save_labels("many.png", torch.arange(96).view(8, 12).repeat_interleave(5, 0).repeat_interleave(5, 1))
    soft = Image.new("L", (60, 40))
    soft.paste(255, (20, 10, 45, 30))
    soft.filter(ImageFilter.GaussianBlur(1)).save("soft.png")
    mistakes = []
    for command, status, words in TRANSCRIPT:
        code, out, err = kcgs(*command.split())
        has_words = words.lower() in (out + err).lower()
        is_rough = "Traceback" in err or ".py:" in err or " nan" in out.lower()
        if not has_words or is_rough or code != status:
            mistakes.append(f"kcgs {command}\n  exit {code}, not {status}; should have {words!r}:\n{out}{err}")
    assert not mistakes, "\n".join(mistakes)
    assert not Path("half.onnx").exists()
