"""The command that runs an experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .common import app
from .options import EngineName


@app.command()
def bench(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Experiment; a wrong name is answered with all of them.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the report.")],
    data: Annotated[Path | None, typer.Option(help="Folder with images, where the experiment needs them.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A short form of the same.")] = False,
    only: Annotated[str | None, typer.Option(help="Parts to run, with commas between, where it has parts.")] = None,
    engine: EngineName = "local",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Fits at a time; seconds that are compared want one, the default.")
    ] = None,
    sequences: Annotated[str | None, typer.Option(help="Of DAVIS, with commas between; default: all.")] = None,
    budget_seconds: Annotated[
        float | None, typer.Option(help="As many fits as this time allows; the same call again goes on.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Fits with so many seeds each.")] = None,
    iterations: Annotated[int | None, typer.Option(min=1, help="Of the published recipes.")] = None,
    redraw: Annotated[
        bool, typer.Option("--redraw", help="Measure nothing: write the report again from the results in the folder.")
    ] = False,
    runs: Annotated[Path | None, typer.Option(help="Folder of the fits, which experiments may share.")] = None,
) -> None:
    """Run an experiment and write its report. An option that the experiment does not take is refused."""
    from kcgs.bench import run

    run(
        name, output, data=data, quick=quick, only=only, engine=engine, workers=workers,
        sequences=sequences, budget_seconds=budget_seconds, seeds=seeds, iterations=iterations, runs=runs,
        redraw=redraw,
    )  # fmt: skip
