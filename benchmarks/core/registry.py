"""Experiments by name: each is a module of `benchmarks` whose `run` has the decorator `experiment`.

Modules whose name begins with an underscore help one of them.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from . import report as reports
from .options import Options

_PACKAGE = __package__.rpartition(".")[0]
_ALWAYS = ("data", "quick")


@dataclass(frozen=True)
class Experiment:
    """An experiment: what measures, the options that it takes besides data and quick, and what writes its report."""

    function: Callable[[Path, Options], None]
    takes: tuple[str, ...] = ()
    report: reports.Report | None = None

    def __call__(self, output: Path, options: Options) -> None:
        """Measure."""
        self.function(output, options)


def experiment(
    *takes: str, report: reports.Report | None = None
) -> Callable[[Callable[[Path, Options], None]], Experiment]:
    """Make a function (folder, options) the experiment that its module is named after.

    The function writes results.csv and calls :func:`benchmarks.core.report.conclude`. It raises a ValueError where what
    is asked cannot be done, and a RuntimeError at its end where fits failed; the others are kept, and in the report.
    `takes` names options besides data and quick; `report` makes the parts of report.md from results.csv, title first.
    """
    return lambda function: Experiment(function, takes, report)


def available_experiments() -> tuple[str, ...]:
    """Names that `python -m benchmarks` takes."""
    modules = pkgutil.iter_modules(import_module(_PACKAGE).__path__)
    return tuple(module.name for module in modules if module.name != "core" and not module.name.startswith("_"))


def run(name: str, output: Path, *, redraw: bool = False, **settings: Any) -> None:
    """Run an experiment and write its report into a folder, or only the report, from the results that are there.

    `settings` are fields of :class:`benchmarks.core.options.Options`, None where not given; a ValueError says what is
    not an experiment, or not taken by it.
    """
    if name not in available_experiments():
        raise ValueError(f"name must be one of {', '.join(available_experiments())}; got {name!r}")
    found: Experiment = import_module(f"{_PACKAGE}.{name}").run
    options = Options(**{key: value for key, value in settings.items() if value is not None})
    changed = [key for key, value in options._asdict().items() if value != options._field_defaults[key]]
    refused = [key for key in changed if key not in (*_ALWAYS, *found.takes)]
    if refused:
        takes = ", ".join((*_ALWAYS, *found.takes))
        raise ValueError(f"{refused[0]} must not be given to {name}, whose options are {takes}")
    if redraw:
        if found.report is None:
            raise ValueError(f"redraw is for experiments with a report; {name} has none")
        reports.redraw(found.report, output)
    else:
        output.mkdir(parents=True, exist_ok=True)
        found(output, options)
    if found.report is not None:
        from rich.console import Console

        Console().print(f"{output}/report.md")
