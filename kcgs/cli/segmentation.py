"""The command that makes label maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcgs._progress import Progress

from .common import OUTPUT_IMAGES, ImageFile, Json, Quiet, app, check_output, print_report, print_table

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.segment import Segmentation

# of the table of regions: title and format of each column
_COLUMNS = {
    "id": ("id", "{}"),
    "name": ("name", "{}"),
    "area": ("area", "{}"),
    "share": ("share", "{:.1%}"),
    "edge_alignment": ("edge alignment", "{:.2f}"),
    "gaussian_share": ("share of Gaussians", "{:.1%}"),
    "score": ("score", "{:.2f}"),
}


def _list_methods(wanted: bool) -> None:
    if wanted:
        from kcgs.segment.registry import available_methods, describe_options

        for method in available_methods():
            typer.echo(f"{method}: {describe_options(method)}")
        raise typer.Exit


@app.command()
def segment(
    image: ImageFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Label map to write: .png or .npy.")],
    method: Annotated[str, typer.Option(help="Where the regions come from; see --methods.")] = "auto",
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Option of the method, as often as needed; the value is JSON or text."),
    ] = None,
    max_regions: Annotated[int | None, typer.Option(min=1, help="The most regions; default: the method's.")] = None,
    overlay: Annotated[
        Path | None, typer.Option(help="Write the image with the regions over it into this file.")
    ] = None,
    quiet: Quiet = False,
    methods: Annotated[
        bool, typer.Option("--methods", is_eager=True, callback=_list_methods, help="List methods and their options.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Make a label map of an image, and list its regions.

    The list has the area of each region, how well its contour lies on edges (0.5 is chance), its share of the Gaussians
    that a fit starts with, and, where the method knows them, its name and score.
    """
    from kcgs.data import load_image, overlay_labels, save_image, save_labels
    from kcgs.segment import segment_with_scores

    check_output(output, ".png", ".npy")
    if overlay is not None:
        check_output(overlay, *OUTPUT_IMAGES, option="--overlay")
    options = _parse_options(option or [])
    if max_regions is not None:
        options["max_regions"] = max_regions
    target = load_image(image)
    with Progress("finding regions", known=False, shown=not quiet):
        found = segment_with_scores(target, method, **options)
    save_labels(output, found.labels)
    if overlay is not None:
        save_image(overlay, overlay_labels(target, found.labels))
    rows, alignment = _rows(target, found)
    areas = [row["area"] for row in rows]
    report = {"regions": len(rows), "smallest": areas[-1], "largest": areas[0], "method": method}
    report["edge_alignment"] = alignment
    print_report({**report, "table": rows} if as_json else report, as_json, str(output))
    if not as_json:
        _print_rows(rows)


def _parse_options(pairs: list[str]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not (equals and key.isidentifier()):
            raise typer.BadParameter(f"--option must be KEY=VALUE; got {pair!r}")
        if key in options:
            raise typer.BadParameter(f"--option {key} is given twice")
        try:
            options[key] = json.loads(text)
        except json.JSONDecodeError:
            options[key] = text
    return options


def _rows(image: Tensor, found: Segmentation) -> tuple[list[dict[str, Any]], float]:
    """Return a row for each region, and the alignment of the whole map; None is what is not known."""
    from kcgs.fitting.kmeans import gaussian_shares
    from kcgs.functional import RegionMap, edge_alignment_map

    aligned = edge_alignment_map(image, found.labels).flatten()
    known = aligned.isfinite()
    flat = found.labels.flatten()
    areas = flat.bincount()
    sums = flat[known].bincount(aligned[known], minlength=len(areas))
    columns = {
        "id": range(len(areas)),
        "name": [None if found.names is None else found.names[region] for region in range(len(areas))],
        "area": areas.tolist(),
        "share": (areas / len(flat)).tolist(),
        "edge_alignment": (sums / flat[known].bincount(minlength=len(areas))).tolist(),
        "gaussian_share": gaussian_shares(image, RegionMap.from_labels(found.labels)).tolist(),
        "score": [None] * len(areas) if found.scores is None else found.scores.tolist(),
    }
    rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    rows = [{key: None if value != value else value for key, value in row.items()} for row in rows]  # NaN is no JSON
    return rows, float(aligned.nanmean())


def _print_rows(rows: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    # what is known of no region gets no column
    shown = [key for key in _COLUMNS if any(row[key] is not None for row in rows)]
    table = Table()
    for key in shown:
        table.add_column(_COLUMNS[key][0], justify="left" if key == "name" else "right")
    for row in rows:
        table.add_row(*("" if row[key] is None else escape(_COLUMNS[key][1].format(row[key])) for key in shown))
    print_table(table)
