"""Data that a wheel holds within the package, and a checkout elsewhere."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def shipped_folder(name: str, *, checkout: str) -> Path:
    """Return where data are, which may be nowhere: a folder of the installed package, or of the checkout's root."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / checkout
