"""The command that makes label maps, and what the others say about maps that users bring."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import IMAGES, Json, app, check_output, print_report

if TYPE_CHECKING:
    from torch import Tensor

# Contours drawn by people reach 0.63 and more on their own image, at most 0.54 on its mirror image.
_ALIGNED = 0.58


@app.command()
def segment(
    image: Annotated[Path, typer.Argument(help="Image file: PNG, JPEG, WebP, TIFF.", metavar="IMAGE")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Label map to write: .png or .npy.")],
    method: Annotated[
        str, typer.Option(help="Where the regions come from; a wrong name lists the right ones.")
    ] = "auto",
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Option of the method, as often as needed; the value is JSON or text."),
    ] = None,
    max_regions: Annotated[int | None, typer.Option(min=1, help="The most regions; default: the method's.")] = None,
    overlay: Annotated[Path | None, typer.Option(help="Draw the regions over the image into this file.")] = None,
    as_json: Json = False,
) -> None:
    """Make a label map of an image, and say of each region its size and how well its contour lies on edges."""
    from kcgs.data import load_image, overlay_labels, save_image, save_labels
    from kcgs.segment import segment as make_labels

    check_output(output, ".png", ".npy")
    if overlay is not None:
        check_output(overlay, *IMAGES, option="--overlay")
    options = _parse_options(option or [])
    if max_regions is not None:
        options["max_regions"] = max_regions
    picture = load_image(image)
    labels = make_labels(picture, method, **options)
    save_labels(output, labels)
    if overlay is not None:
        save_image(overlay, overlay_labels(picture, labels))
    rows, alignment = _table(picture, labels)
    report = {
        "regions": len(rows),
        "smallest": rows[-1]["area"],
        "largest": rows[0]["area"],
        "method": method,
        "edge_alignment": alignment,
    }
    if as_json:
        print_report({**report, "table": rows}, True, str(output))
        return
    print_report(report, False, str(output))
    _print_table(rows)


def warn_if_misaligned(picture: Tensor, labels: Tensor, name: str) -> None:
    """Say on standard error that a map's contours lie beside the image's edges, with the figure, where they do."""
    from kcgs.functional import edge_alignment

    if labels.shape != picture.shape[1:]:
        return  # the fit says so
    figure = float(edge_alignment(picture, labels))
    if figure < _ALIGNED:
        typer.echo(
            f"warning: the contours of {name} hardly follow the image's edges: alignment {figure:.2f}, where chance "
            "gives 0.50 and good masks 0.63 or more; does the mask belong to this image?",
            err=True,
        )


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


def _table(picture: Tensor, labels: Tensor) -> tuple[list[dict[str, Any]], float]:
    """Return a row for each region, and the alignment of the whole map; None where a region has no contour."""
    from kcgs.functional import edge_alignment_map

    aligned = edge_alignment_map(picture, labels).flatten()
    known = aligned.isfinite()
    flat = labels.flatten()
    areas = flat.bincount()
    sums = flat[known].bincount(aligned[known], minlength=len(areas))
    means = (sums / flat[known].bincount(minlength=len(areas))).tolist()
    rows = [
        {"id": region, "area": area, "share": area / len(flat), "edge_alignment": None if math.isnan(mean) else mean}
        for region, (area, mean) in enumerate(zip(areas.tolist(), means, strict=True))
    ]
    return rows, float(aligned.nanmean())


def _print_table(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("id", "area", "share", "edge alignment")
    for column in table.columns:
        column.justify = "right"
    for row in rows:
        mean = row["edge_alignment"]
        table.add_row(str(row["id"]), str(row["area"]), f"{row['share']:.1%}", "" if mean is None else f"{mean:.2f}")
    Console().print(table)
