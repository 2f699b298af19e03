"""Data that a wheel holds within the package, and a checkout elsewhere."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def shipped_folder(name: str, *, checkout: str) -> Path:
    """Return where data are, which may be nowhere.

    Args:
        name: of the folder within an installed package.
        checkout: the folder in a checkout, from its root.
    """
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / checkout
