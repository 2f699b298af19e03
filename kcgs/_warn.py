"""Warnings that name the user's line that called kcgs, however deep inside they arise."""

from __future__ import annotations

import sys
import warnings

_INTERNAL = ("kcgs", "torch", "contextlib")  # torch and contextlib: their decorators lie between functions of kcgs


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn with the line of the first caller outside kcgs."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in _INTERNAL:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
