"""The fitted scenes that come with the package, by name."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import NamedTuple

from kcgs._repr import brief

_PACKAGE = Path(__file__).resolve().parent
# within the package in a wheel, beside it in a checkout
_FOLDER = _PACKAGE / "models" if (_PACKAGE / "models").is_dir() else _PACKAGE.parent / "models"
PREFIX = "zoo:"


@brief
class Entry(NamedTuple):
    """A scene of the zoo, as its manifest has it."""

    name: str
    title: str
    scene: str  # file, relative to the folder
    sha256: str
    bytes: int
    recipe: str
    num_gaussians: int
    num_regions: int
    psnr: float
    ef_psnr: float | None
    licence: str
    command: str


def entries(folder: Path | None = None) -> list[Entry]:
    """Read the manifest of a zoo's folder; None: the package's own."""
    path = (folder or _FOLDER) / "manifest.json"
    if not path.is_file():
        raise FileNotFoundError(f"there is no zoo of fitted scenes: {path} is not there; install kcgs again")
    try:
        return [Entry(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))["entries"]]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must be a zoo's manifest; {error}") from None


def find(name: str, folder: Path | None = None) -> Path:
    """Return the scene file of an entry, its hash checked; the name may begin with "zoo:"."""
    wanted = name.removeprefix(PREFIX)
    known = {entry.name: entry for entry in entries(folder)}
    if wanted not in known:
        raise ValueError(f"zoo entry must be one of {', '.join(known)}; got {wanted!r}")
    path = (folder or _FOLDER) / known[wanted].scene
    if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != known[wanted].sha256:
        raise ValueError(f"{path} must be the file that the manifest names; it is missing or was changed")
    return path
