"""Shared parts of the commands: arguments, checks of outputs, errors, Ctrl-C."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import check_writable
from kcgs._suffixes import LABEL_MAPS, SCENES
from kcgs.errors import InvalidArgument

# exit status of a command that Ctrl-C ended
INTERRUPTED = 130


def _scene_path(text: str, other_suffixes: tuple[str, ...] = ()) -> Path:
    from kcgs.zoo import locate

    try:
        path = locate(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    if path.suffix not in SCENES and path.suffix.lower() not in other_suffixes:
        suffixes = " or ".join((*SCENES, *other_suffixes))
        raise typer.BadParameter(f"must end in {suffixes}, or be zoo:NAME; got {text!r}")
    return path


SceneFile = Annotated[
    Path,
    typer.Argument(help="Scene (.safetensors or .kcgs), or zoo:NAME.", metavar="SCENE", parser=_scene_path),
]
SceneOrMap = Annotated[
    Path,
    typer.Argument(
        help="Scene, or zoo:NAME; or label map: .png, .npy and others.",
        metavar="FILE",
        parser=lambda text: _scene_path(text, LABEL_MAPS),
    ),
]
ImageFile = Annotated[Path, typer.Argument(help="Image file: PNG, JPEG, WebP, TIFF.", metavar="IMAGE", dir_okay=False)]


def _log_warnings_only(is_set: bool) -> bool:
    if is_set:
        logging.getLogger("kcgs").setLevel(logging.WARNING)
    return is_set


Quiet = Annotated[bool, typer.Option("-q", "--quiet", callback=_log_warnings_only, help="Show no progress.")]
Json = Annotated[
    bool, typer.Option("--json", callback=_log_warnings_only, help="Print one JSON object on standard output.")
]


def check_output(path: Path, *suffixes: str, name: str = "output") -> None:
    """Refuse an output that cannot be written, before the work starts."""
    # suffixes of scenes are case-sensitive, suffixes of images are not
    suffix = path.suffix.lower() if path.suffix.lower() in LABEL_MAPS else path.suffix
    if suffix not in suffixes:
        raise InvalidArgument(name, " or ".join(suffixes), repr(str(path)), verb="end in")
    check_writable(f"--{name}", path)


def check_new(path: Path, overwrite: bool) -> None:
    """Refuse an output that exists, before the work starts, unless it may be replaced."""
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; --overwrite replaces it")


def describe_error(error: Exception) -> str:
    """Return an error's message on one line, or its type if it has none."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.strerror}: {error.filename}"
    return " ".join(str(error).split()) or type(error).__name__


class InterruptHandler:
    """In a `with` block, the first Ctrl-C stops a fit, which is then saved; the second ends the command."""

    count = 0
    """Number of Ctrl-C in the block."""

    def __enter__(self) -> InterruptHandler:
        self._outer_handler = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        signal.signal(signal.SIGINT, self._outer_handler)

    def _interrupt(self, number: int, frame: Any) -> None:
        self.count += 1
        if self.count > 1:
            raise KeyboardInterrupt

    def on_step(self, iteration: int, entry: Any) -> bool:
        """Return whether the fit must stop: the argument `on_step` of :func:`kcgs.fit`."""
        return self.count > 0


def exit_interrupted(result: str) -> typer.Exit:
    """Print what was saved after Ctrl-C, and return the exception that ends the command."""
    typer.echo(f"kcgs: interrupted: saved {result}", err=True)
    return typer.Exit(INTERRUPTED)
