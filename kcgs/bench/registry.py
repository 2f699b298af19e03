"""Experiments by name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

_EXPERIMENTS = ("demo", "render")


def available_experiments() -> tuple[str, ...]:
    """Names that `kcgs bench` takes."""
    return _EXPERIMENTS


def run(name: str, output: Path, *, data: Path | None = None, quick: bool = False) -> None:
    """Run an experiment and write its report into the folder `output`, which is made if it is not there.

    Args:
        name: of the experiment.
        output: folder.
        data: folder with images, for the experiments that need it.
        quick: a short form of the same experiment.

    Raises:
        ValueError: unknown name.
        OSError: the folder cannot be made.
    """
    if name not in _EXPERIMENTS:
        raise ValueError(f"name must be one of {', '.join(_EXPERIMENTS)}; got {name!r}")
    output.mkdir(parents=True, exist_ok=True)
    import_module(f"{__package__}.{name}").run(output, data=data, quick=quick)
