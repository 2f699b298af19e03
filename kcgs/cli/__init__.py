"""The command `kcgs`."""

import logging
import sys

import typer

from . import batch, commands, decoders, files, segmentation  # each puts its commands into `app`
from .common import app

__all__ = ["app", "batch", "commands", "decoders", "files", "main", "segmentation"]


def main() -> None:
    """Run the command: exit 0 done, 1 failed with one line that says why, 2 wrong usage."""
    logging.basicConfig(format="%(message)s")
    logging.getLogger("kcgs").setLevel(logging.INFO)
    try:
        app(prog_name="kcgs")
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        typer.echo(f"kcgs: {' '.join(str(error).split()) or type(error).__name__}", err=True)
        sys.exit(1)
