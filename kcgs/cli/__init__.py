"""The command `kcgs`."""

import logging
import os
import sys
import warnings

import typer

from kcgs.errors import InvalidArgument, InvalidArgumentType

# each puts its commands into `app`, in the order of `kcgs --help`
from . import fit, many, video, scenes, segmentation, decoders, demo  # isort: skip
from .common import app

__all__ = ["app", "decoders", "demo", "fit", "main", "many", "scenes", "segmentation", "video"]


def main() -> None:
    """Run the command: exit 0 done, 1 failed with one line that says why, 2 wrong usage.

    Wrong usage is also an option's or argument's value that the library refuses.
    """
    # read when torch is loaded, which no import above does: its threads sleep while they wait, and take no core from
    # other programs
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("kcgs").setLevel(logging.INFO)
    option = None
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _say
            app(prog_name="kcgs")
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        if isinstance(error, InvalidArgument | InvalidArgumentType) and (option := _option(error.name, sys.argv[1])):
            error.name = option
        message = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            message = f"{error.strerror}: {error.filename}"
        typer.echo(f"kcgs: {' '.join(message.split()) or type(error).__name__}", err=True)
        sys.exit(2 if option else 1)


def _say(message: Warning | str, *_: object, **__: object) -> None:
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


def _option(name: str, command: str) -> str | None:
    """Return a command's option or argument by the name of its parameter, as people write it."""
    for parameter in typer.main.get_command(app).commands[command].params:  # type: ignore[attr-defined]
        if parameter.name == name:
            is_option = parameter.opts[0].startswith("-")
            return str(max(parameter.opts, key=len) if is_option else parameter.metavar.rstrip("."))
    return None
