"""Other ways to store a picture, in the bytes of our file: JPEG, WebP, AVIF, a small network."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs.bench.measure import measure
from kcgs.bench.rate.codecs import largest, open_file, present

from . import siren

GAUSSIAN_TOOLS_TEXT = """No other tool that fits 2D Gaussians to pictures is in the table. The registry's list has
`gsplat`, which draws on CUDA only; GaussianImage and Image-GS are not on it, and their code needs CUDA. `splatthis`
0.3.2, which writes splats as SVG, does run on a processor: told to make 1,250 of a DAVIS frame in its profile `fast`,
it was stopped after 285 core seconds, having done between 50 and 100 of its 500 iterations."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Peer:
    """A picture in about the bytes asked for, and how good it is."""

    name: str
    bytes: int
    psnr: float
    ms_ssim: float
    ef_psnr: float
    ef_ssim: float
    seconds: float
    note: str = ""
    history: tuple[tuple[float, float, float], ...] = ()  # seconds, PSNR, EF-PSNR


def codecs(image: Tensor, labels: Tensor, size: int) -> list[Peer]:
    """Encode with every codec that Pillow has, at its best effort, into the largest file of at most `size` bytes."""
    return [codec(name, image, labels, size) for name in present()]


def codec(name: str, image: Tensor, labels: Tensor, size: int) -> Peer:
    """Encode with one codec; where even its smallest file is larger, that one, and a note says so."""
    coded = largest(name, image, size)
    note = "its smallest file is larger" if len(coded.data) > size else ""
    told = {"name": name, "bytes": len(coded.data), "seconds": coded.seconds, "note": note}
    return _measured(open_file(coded.data), image, labels, **told)


def network(image: Tensor, labels: Tensor, size: int, seconds: float) -> Peer:
    """Train a SIREN whose half-precision weights fit into `size` bytes."""
    trained = siren.train(image, size, seconds=seconds)
    curve = []
    for spent, picture in trained.history:
        figures = measure(picture, image, labels)
        curve.append((spent, figures["psnr"], figures["ef_psnr"]))
    return _measured(
        trained.picture,
        image,
        labels,
        name="SIREN",
        bytes=trained.bytes,
        seconds=trained.seconds,
        note=f"{trained.width} wide, {trained.iterations:,} iterations",
        history=tuple(curve),
    )


def ensure_network(path: Path, image: Tensor, labels: Tensor, size: int, seconds: float) -> Peer:
    """Read a trained network's figures, after training it where they are not there."""
    if not path.is_file():
        peer = network(image, labels, size, seconds)
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(peer)), encoding="utf-8")
    kept = json.loads(path.read_text(encoding="utf-8"))
    return Peer(**{**kept, "history": tuple((s, p, e) for s, p, e in kept["history"])})


def _measured(picture: Tensor, image: Tensor, labels: Tensor, **told: Any) -> Peer:
    figures = measure(picture, image, labels)
    shown: dict[str, Any] = {key: figures[key] for key in ("psnr", "ms_ssim", "ef_psnr", "ef_ssim")}
    return Peer(**shown, **told)
