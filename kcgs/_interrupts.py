"""What the command `kcgs` sets before anything else is imported; other processes keep theirs.

Ctrl-C: one line and exit status 130. And torch's threads sleep while they wait: spinning, they take many times as long
where other programs run.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

STATUS = 128 + signal.SIGINT


def leave(number: int = 0, frame: FrameType | None = None) -> NoReturn:
    """End at once: nothing is open yet, or any more, and libraries that are half loaded can do nothing else."""
    os.write(2, b"kcgs: interrupted\n")
    os._exit(STATUS)


@contextmanager
def raised() -> Iterator[list[int]]:
    """Have Ctrl-C raise KeyboardInterrupt meanwhile, where it would have left; yield what is empty until it came.

    Libraries make other errors of a KeyboardInterrupt.
    """
    came: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        came.append(number)
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is leave:
        signal.signal(signal.SIGINT, interrupt)
    try:
        yield came
    finally:
        if before is leave:
            signal.signal(signal.SIGINT, leave)


def _is_command() -> bool:
    """Say whether this process is the command, not one that imports the library or does a command's jobs."""
    name = os.path.basename(sys.argv[0]) if getattr(sys, "argv", None) else ""
    # a module that is run has no name yet while its package is imported
    run = name == "-m" and "kcgs.cli" in sys.orig_argv
    return run or (name.removesuffix(".exe") == "kcgs" and "--multiprocessing-fork" not in sys.orig_argv)


def _unraisable(report: Any) -> None:
    # Ctrl-C came where Python cannot raise, in a destructor
    if isinstance(report.exc_value, KeyboardInterrupt):
        leave()
    sys.__unraisablehook__(report)


if _is_command():
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
if _is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, leave)
    sys.unraisablehook = _unraisable
