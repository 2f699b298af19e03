"""The command that makes label maps, and what the others say about maps that users bring."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import IMAGES, Json, app, check_output, print_report

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.segment import Segmentation

# Contours drawn by people reach 0.63 and more on their own image, at most 0.54 on its mirror image.
_ALIGNED = 0.58
# of the table of regions: title and text of each column
_COLUMNS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "id": ("id", str),
    "name": ("name", str),
    "area": ("area", str),
    "share": ("share", "{:.1%}".format),
    "edge_alignment": ("edge alignment", "{:.2f}".format),
    "gaussian_share": ("share of Gaussians", "{:.1%}".format),
    "score": ("score", "{:.2f}".format),
}
_KNOWN = ("id", "area", "share", "edge_alignment", "gaussian_share")


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
    """Make a label map of an image, and list its regions.

    The list says of each its area, how well its contour lies on edges (0.5 is chance), the share of the Gaussians that
    a fit starts with there, and, where the method knows them, its name and score.
    """
    from kcgs.data import load_image, overlay_labels, save_image, save_labels
    from kcgs.segment import segment_with_scores

    check_output(output, ".png", ".npy")
    if overlay is not None:
        check_output(overlay, *IMAGES, option="--overlay")
    options = _parse_options(option or [])
    if max_regions is not None:
        options["max_regions"] = max_regions
    picture = load_image(image)
    found = segment_with_scores(picture, method, **options)
    save_labels(output, found.labels)
    if overlay is not None:
        save_image(overlay, overlay_labels(picture, found.labels))
    rows, alignment = _table(picture, found)
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


def misalignment(picture: Tensor, labels: Tensor, name: str) -> str | None:
    """Say that a map's contours lie beside the image's edges, with the figure, where they do; None: they do not."""
    from kcgs.functional import edge_alignment

    if labels.shape != picture.shape[1:]:
        return None  # the fit says so
    figure = float(edge_alignment(picture, labels))
    if figure >= _ALIGNED:
        return None
    return (
        f"warning: the contours of {name} hardly follow the image's edges: alignment {figure:.2f}, where chance "
        "gives 0.50 and good masks 0.63 or more; does the mask belong to this image?"
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


def _table(picture: Tensor, found: Segmentation) -> tuple[list[dict[str, Any]], float]:
    """Return a row for each region, and the alignment of the whole map; None is what is not known."""
    from kcgs.fit.kmeans import gaussian_shares
    from kcgs.functional import RegionMap, edge_alignment_map

    aligned = edge_alignment_map(picture, found.labels).flatten()
    known = aligned.isfinite()
    flat = found.labels.flatten()
    areas = flat.bincount()
    sums = flat[known].bincount(aligned[known], minlength=len(areas))
    columns = {
        "area": areas.tolist(),
        "share": (areas / len(flat)).tolist(),
        "edge_alignment": (sums / flat[known].bincount(minlength=len(areas))).tolist(),
        "gaussian_share": gaussian_shares(picture, RegionMap.from_labels(found.labels)).tolist(),
        "score": [None] * len(areas) if found.scores is None else found.scores.tolist(),
    }
    rows = []
    for region in range(len(areas)):
        row = {name: values[region] for name, values in columns.items()}
        row = {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in row.items()}
        rows.append({"id": region, "name": None if found.names is None else found.names[region], **row})
    return rows, float(aligned.nanmean())


def _print_table(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    # a method without names or scores gets no empty columns for them
    shown = {key: _COLUMNS[key] for key in _COLUMNS if key in _KNOWN or any(row[key] is not None for row in rows)}
    table = Table()
    for title, _ in shown.values():
        table.add_column(title, justify="left" if title == "name" else "right")
    for row in rows:
        table.add_row(*("" if row[key] is None else escape(text(row[key])) for key, (_, text) in shown.items()))
    Console().print(table)
