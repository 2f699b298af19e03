"""The command `kcgs`."""

import logging
import re
import sys
import warnings

import typer

# each puts its commands into `app`, in the order of `kcgs --help`
from . import fit, many, scenes, segmentation, decoders  # isort: skip
from .common import app

__all__ = ["app", "decoders", "fit", "main", "many", "scenes", "segmentation"]


def main() -> None:
    """Run the command: exit 0 done, 1 failed with one line that says why, 2 wrong usage."""
    logging.basicConfig(format="%(message)s")
    logging.getLogger("kcgs").setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _say
            app(prog_name="kcgs")
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        message = " ".join(str(error).split()) or type(error).__name__
        typer.echo(f"kcgs: {_name_options(message, sys.argv[1])}", err=True)
        sys.exit(1)


def _say(message: Warning | str, *_: object, **__: object) -> None:
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


def _name_options(message: str, command: str) -> str:
    """Name the options of a command where the library's message begins with the name of an argument."""
    for parameter in typer.main.get_command(app).commands[command].params:  # type: ignore[attr-defined]
        option = max(parameter.opts, key=len) if parameter.param_type_name == "option" else parameter.metavar
        message = re.sub(rf"^{parameter.name}(_ids)?\b(?=:| must| ')", option, message)
    return message
