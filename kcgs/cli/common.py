"""What the commands share: the app, arguments, reports, progress."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import check_writable
from kcgs._progress import Progress

# typer may have click or a copy of it
_UsageError: Any = typer.BadParameter.__mro__[1]
# exit statuses, as a shell gives them to a program that a signal ended
_INTERRUPTED = 128 + signal.SIGINT
_PIPE_CLOSED = 128 + 13


class _InterruptHandler:
    """What Ctrl-C calls: it raises KeyboardInterrupt, of which libraries that are being loaded make other errors."""

    called = False

    def __call__(self, number: int, frame: Any) -> None:
        self.called = True
        raise KeyboardInterrupt


class _Commands(typer.core.TyperGroup):
    """The commands, ended in one way by Ctrl-C and by a reader of standard output who leaves."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        Progress.forget()
        handler, before = _InterruptHandler(), signal.getsignal(signal.SIGINT)
        # not where Ctrl-C is ignored, as in the background, nor in a thread, where Python sets no handler
        listens = before is signal.default_int_handler and threading.current_thread() is threading.main_thread()
        if listens:
            signal.signal(signal.SIGINT, handler)
        try:
            result = super().invoke(ctx)
        except BaseException as error:
            if handler.called or isinstance(error, KeyboardInterrupt):
                raise interrupted(str(error) if isinstance(error, KeyboardInterrupt) else "") from None
            if isinstance(error, BrokenPipeError):
                # what is left in the buffer has nowhere to go
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise typer.Exit(_PIPE_CLOSED) from error
            if isinstance(error, _UsageError) and ctx.invoked_subcommand == "fit" and "extra arg" in error.message:
                raise _UsageError(f"{error.message}: kcgs fit-many fits several images", error.ctx) from None
            raise
        finally:
            if listens:
                signal.signal(signal.SIGINT, before)
        if handler.called:  # where Python cannot raise, in a destructor
            raise interrupted()
        return result


def interrupted(detail: str = "") -> typer.Exit:
    """Say in one line that Ctrl-C came, and return what ends the command."""
    typer.echo(f"kcgs: interrupted{detail and ': ' + detail}", err=True)
    return typer.Exit(_INTERRUPTED)


app = typer.Typer(
    cls=_Commands,
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
VIDEOS = (".mp4", ".mkv", ".mov", ".webm")
# before the name of a shipped scene
_ZOO = "zoo:"
# what label maps are read from
_LABEL_MAPS = (".png", ".npy", ".tif", ".tiff", ".gif", ".bmp", ".webp")


def _scene_path(text: str, others: tuple[str, ...] = ()) -> Path:
    path = Path(text)
    if text.startswith(_ZOO):
        from kcgs.zoo import find

        try:
            path = find(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
    if path.suffix not in SCENES and path.suffix.lower() not in others:
        photo = ": kcgs fit makes scenes of images" if path.suffix.lower() in IMAGES else ""
        kinds = " or ".join((*SCENES, *others))
        raise typer.BadParameter(f"it must end in {kinds}, or be {_ZOO}NAME; got {text!r}{photo}")
    return path


SceneFile = Annotated[
    Path,
    typer.Argument(help="Scene (.safetensors or .kcgs), or zoo:NAME.", metavar="SCENE", parser=_scene_path),
]
_EITHER = "Scene, or zoo:NAME; or label map: .png, .npy and others."
SceneOrMap = Annotated[
    Path, typer.Argument(help=_EITHER, metavar="FILE", parser=lambda text: _scene_path(text, _LABEL_MAPS))
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
    suffix = path.suffix.lower() if path.suffix.lower() in (*OUTPUT_IMAGES, ".npy") else path.suffix
    if suffix not in suffixes:
        raise typer.BadParameter(f"{option} must end in {' or '.join(suffixes)}; got {str(path)!r}")
    check_writable(option, path)


def print_report(report: dict[str, Any], as_json: bool, title: str, contours: str = "") -> None:
    """Print a table, or one JSON object; the table says along which contours edge-focused figures were taken."""
    if as_json:
        clean = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in report.items()}
        typer.echo(json.dumps(clean))
        return
    from rich.table import Table

    table = Table("", title, show_header=True)
    for key, value in report.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            table.add_row(key, "not defined" if text == "nan" else text)
        if key == "ef_ssim" and contours:
            table.add_row("ef_psnr, ef_ssim", f"along the contours of {contours}")
    print_table(table)


def print_table(table: Any) -> None:
    """Print a table of rich's, which by itself would end the program where the reader has left."""
    from rich.console import Console

    console = Console()
    with console.capture() as text:
        console.print(table)
    typer.echo(text.get(), nl=False)


class Stop:
    """Ctrl-C as a wish that a fit stop and be saved; before it has begun, or a second time, it ends the command."""

    def __init__(self) -> None:
        self.wanted = self._began = False

    def __enter__(self) -> Stop:
        self._before: Any = signal.getsignal(signal.SIGINT)
        if callable(self._before):  # it is not where Ctrl-C is ignored, as in the background
            signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        if callable(self._before):
            signal.signal(signal.SIGINT, self._before)

    def _interrupt(self, number: int, frame: Any) -> None:
        if self.wanted or not self._began:
            self._before(number, frame)
        self.wanted = True

    def step(self, iteration: int, entry: Any) -> bool:
        """Say whether the fit is to stop; `on_step` of :func:`kcgs.fit`."""
        self._began = True
        return self.wanted
