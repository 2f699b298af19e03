"""What the commands share: the app, arguments, reports, progress."""

from __future__ import annotations

import json
import math
import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import atomic_path

app = typer.Typer(
    help="Contour-aware 2D Gaussian splatting of images.",
    no_args_is_help=True,
    add_completion=False,
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


IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def _scene_path(text: str) -> Path:
    from kcgs.zoo import PREFIX, find

    return find(text) if text.startswith(PREFIX) else Path(text)


SceneFile = Annotated[
    Path, typer.Argument(help="Scene file (.safetensors or .kcgs), or zoo:NAME.", metavar="SCENE", parser=_scene_path)
]
ImageFile = Annotated[Path, typer.Argument(help="Image file: PNG, JPEG, WebP, TIFF.", metavar="IMAGE")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


def check_output(path: Path, *suffixes: str, option: str = "--output") -> None:
    """Refuse an output that cannot be written, before the work, not after it."""
    # scenes are written by their exact suffix, images in any case
    suffix = path.suffix.lower() if path.suffix.lower() in IMAGES else path.suffix
    if suffix not in suffixes:
        raise ValueError(f"{option} must end in {' or '.join(suffixes)}; got {str(path)!r}")
    if not path.resolve().parent.is_dir():
        raise FileNotFoundError(f"{option} needs an existing folder; {str(path.resolve().parent)!r} is not there")


def write_file(path: Path, data: bytes) -> int:
    """Write a file whole or not at all; return its bytes."""
    with atomic_path(path) as temporary:
        return temporary.write_bytes(data)


def print_report(report: dict[str, Any], as_json: bool, title: str) -> None:
    """Print a table, or one JSON object."""
    if as_json:
        clean = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in report.items()}
        typer.echo(json.dumps(clean))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("", title, show_header=True)
    for key, value in report.items():
        table.add_row(key, f"{value:.4g}" if isinstance(value, float) else str(value))
    Console().print(table)


class Progress:
    """Bar on standard error, only on a terminal, and Ctrl-C as a wish to stop; a second Ctrl-C ends the program."""

    def __init__(self, iterations: int) -> None:
        from rich.progress import TextColumn, TimeElapsedColumn

        self.interrupted = False
        self._bar = progress_bar(TimeElapsedColumn(), TextColumn("{task.fields[quality]}"))
        self._task = self._bar.add_task("fit", total=iterations, quality="")

    def __enter__(self) -> Progress:
        self._before = signal.signal(signal.SIGINT, self._interrupt)
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()
        signal.signal(signal.SIGINT, self._before)

    def _interrupt(self, number: int, frame: object) -> None:
        self.interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def step(self, iteration: int, entry: Any) -> bool:
        """Show the iteration; say whether to stop."""
        self._bar.update(self._task, completed=iteration, quality=f"{entry.psnr:.2f} dB")
        return self.interrupted


def progress_bar(*columns: Any) -> Any:
    """Make a bar on standard error, shown only on a terminal, with columns beside its own and the remaining time."""
    from rich.console import Console
    from rich.progress import Progress, TimeRemainingColumn

    console = Console(stderr=True)
    first = Progress.get_default_columns()[:2]
    return Progress(*first, *columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal)
