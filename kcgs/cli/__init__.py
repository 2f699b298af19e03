"""The command `kcgs`."""

import logging
import os
import re
import sys
import warnings

import typer

# each puts its commands into `app`, in the order of `kcgs --help`
from . import fit, many, video, scenes, segmentation, decoders, demo  # isort: skip
from .common import app

__all__ = ["app", "decoders", "demo", "fit", "main", "many", "scenes", "segmentation", "video"]


def main() -> None:
    """Run the command: exit 0 done, 1 failed with one line that says why, 2 wrong usage.

    Wrong usage is also what the library refuses by a message that says what an option or argument must be.
    """
    # read when torch is loaded, which no import above does: its threads sleep while they wait, and take no core from
    # other programs
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("kcgs").setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _say
            app(prog_name="kcgs")
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        if isinstance(error, OSError) and error.filename is not None:
            message = f"{(error.strerror or 'no').lower().removesuffix(' or directory')}: {error.filename}"
        else:
            message = " ".join(str(error).split()) or type(error).__name__
        message, wrong = _name_options(message, sys.argv[1])
        typer.echo(f"kcgs: {message}", err=True)
        sys.exit(2 if wrong and isinstance(error, ValueError | TypeError) else 1)


def _say(message: Warning | str, *_: object, **__: object) -> None:
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


def _name_options(message: str, command: str) -> tuple[str, bool]:
    """Name the option where a message begins with the name of an argument; say whether it was used wrongly."""
    wrong = False
    for parameter in typer.main.get_command(app).commands[command].params:  # type: ignore[attr-defined]
        option = max(parameter.opts, key=len) if parameter.opts[0].startswith("-") else parameter.metavar.rstrip(".")
        message = re.sub(rf"^{parameter.name}(_ids)?\b(?=:| must| ')", option, message)
        # what must be otherwise; a file that is damaged, or of another fit, is no wrong use
        wrong |= message.startswith((f"{option} must", f"{option}: "))
    return message, wrong
