"""The entry point: set up the process, run a command, report an error in one line and an exit status."""

import logging
import os
import sys
import warnings

import typer

# each module adds its commands to `app`, in the order of `kcgs --help`
from . import fit, many, video, scenes, edit, segmentation, decoders, demo  # noqa: F401  # isort: skip
from .commands import app
from .common import describe_error


def main() -> None:
    """Run a command: exit status 0 done, 1 failed with one line that says why, 2 wrong usage or a missing file."""
    # torch reads this when it is loaded, later: waiting threads then sleep, and take no core from other programs
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("kcgs").setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _print_warning
            app(prog_name="kcgs")
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        typer.echo(f"kcgs: {describe_error(error)}", err=True)
        sys.exit(2 if isinstance(error, FileNotFoundError) else 1)


def _print_warning(message: Warning | str, *_: object, **__: object) -> None:
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)
