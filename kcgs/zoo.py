"""Fitted scenes that come with the package, by name."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import NamedTuple

from kcgs._repr import brief

__all__ = ["Entry", "entries", "find", "locate"]

_PACKAGE = Path(__file__).resolve().parent
# the folder of scenes: inside the package in a wheel, beside the package in a checkout
_FOLDER = _PACKAGE / "models" if (_PACKAGE / "models").is_dir() else _PACKAGE.parent / "models"
_PREFIX = "zoo:"


@brief
class Entry(NamedTuple):
    """The entry of a scene in the zoo's manifest."""

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
    """Read the manifest in the folder of a zoo; None: the zoo of the package."""
    path = (folder or _FOLDER) / "manifest.json"
    if not path.is_file():
        raise FileNotFoundError(f"no zoo of fitted scenes: {path} does not exist; install kcgs again")
    try:
        return [Entry(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))["entries"]]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must be a zoo's manifest; {error}") from None


def find(name: str, folder: Path | None = None) -> Path:
    """Return the path of a scene's file after checking its hash; the name may begin with "zoo:"."""
    by_name = {entry.name: entry for entry in entries(folder)}
    entry = by_name.get(name.removeprefix(_PREFIX))
    if entry is None:
        raise ValueError(f"zoo entry must be one of {', '.join(by_name)}; got {name!r}")
    path = (folder or _FOLDER) / entry.scene
    if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != entry.sha256:
        raise ValueError(f"{path} must be the file that the manifest names; it is missing or was changed")
    return path


def locate(path: str | os.PathLike[str]) -> Path:
    """Return the path of a scene; "zoo:NAME" is a scene of the zoo, any other string is a path."""
    return find(str(path)) if str(path).startswith(_PREFIX) else Path(path)
