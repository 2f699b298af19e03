"""What the commands share: the app, arguments, reports, Ctrl-C."""

from __future__ import annotations

import json
import logging
import math
import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import check_writable

# exit status of a program that Ctrl-C ended
INTERRUPTED = 130

app = typer.Typer(
    help="Contour-aware 2D Gaussian splatting of images.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from kcgs import __version__

        typer.echo(f"kcgs {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Take options that come before a command."""


# the keys of `kcgs.scene.FORMATS`, whose module loads torch
SCENES = (".safetensors", ".kcgs")
OUTPUT_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
# the files of a folder that are images; a file that is named is tried whatever it is called
IMAGES = (*OUTPUT_IMAGES, ".gif")
# videos that H.264 is written into
VIDEOS = (".mp4", ".mov", ".mkv")


# what label maps are read from
LABEL_MAPS = (*IMAGES, ".npy")


def _scene_path(text: str, others: tuple[str, ...] = ()) -> Path:
    if text.startswith("zoo:"):
        from kcgs.zoo import find

        try:
            return find(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
    path = Path(text)
    if path.suffix not in SCENES and path.suffix.lower() not in others:
        raise typer.BadParameter(f"it must end in {' or '.join((*SCENES, *others))}, or be zoo:NAME; got {text!r}")
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


def _hush(wanted: bool) -> bool:
    """Let the log speak of warnings only."""
    if wanted:
        logging.getLogger("kcgs").setLevel(logging.WARNING)
    return wanted


Quiet = Annotated[bool, typer.Option("-q", "--quiet", callback=_hush, help="Show no progress.")]
Json = Annotated[bool, typer.Option("--json", callback=_hush, help="Print one JSON object on standard output.")]


def check_output(path: Path, *suffixes: str, option: str = "--output") -> None:
    """Refuse an output that cannot be written, before the work, not after it."""
    # scenes are written by their exact suffix, images in any case
    suffix = path.suffix.lower() if path.suffix.lower() in LABEL_MAPS else path.suffix
    if suffix not in suffixes:
        raise typer.BadParameter(f"{option} must end in {' or '.join(suffixes)}; got {str(path)!r}")
    check_writable(option, path)


def clean(report: dict[str, Any]) -> dict[str, Any]:
    """Replace numbers that JSON does not have by None."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in report.items()}


def print_report(report: dict[str, Any], as_json: bool, title: str) -> None:
    """Print a table, or one JSON object."""
    if as_json:
        typer.echo(json.dumps(clean(report)))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("", title)
    for key, value in report.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            table.add_row(key, "not defined" if text == "nan" else text)
    Console(markup=False).print(table)


class Stop:
    """Ctrl-C as a wish that a fit stop and be saved; a second one ends the command."""

    wanted = False

    def __enter__(self) -> Stop:
        self._before = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _interrupt(self, number: int, frame: Any) -> None:
        if self.wanted:
            raise KeyboardInterrupt
        self.wanted = True

    def step(self, iteration: int, entry: Any) -> bool:
        """Return whether the fit is to stop; `on_step` of :func:`kcgs.fit`."""
        return self.wanted


def exit_interrupted(saved: str) -> typer.Exit:
    """Print what was saved after Ctrl-C, and return what ends the command."""
    typer.echo(f"kcgs: interrupted: saved {saved}", err=True)
    return typer.Exit(INTERRUPTED)
