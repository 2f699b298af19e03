"""The command that makes label maps."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._progress import Progress
from kcgs._suffixes import WRITTEN_IMAGES
from kcgs.errors import InvalidArgument

from .commands import app
from .common import ImageFile, Json, Quiet, check_output
from .reports import print_report, replace_undefined


def _list_methods(is_set: bool) -> None:
    if is_set:
        from kcgs.segment import available_methods, method_options

        for method in available_methods():
            options = [
                name if default is inspect.Parameter.empty else f"{name}={default!r}"
                for name, default in method_options(method).items()
            ]
            typer.echo(f"{method}: {', '.join(options)}")
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
    box: Annotated[
        str | None, typer.Option(metavar="X0,Y0,X1,Y1", help="Of grabcut, object and sam: a box around the object.")
    ] = None,
    foreground: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="Of grabcut, object and sam: a point of the object.")
    ] = None,
    background: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Of grabcut, object and sam: a point beside the object."),
    ] = None,
    overlay: Annotated[
        Path | None, typer.Option(help="Write the image with the regions and their ids over it into this file.")
    ] = None,
    quiet: Quiet = False,
    methods: Annotated[
        bool, typer.Option("--methods", is_eager=True, callback=_list_methods, help="List methods and their options.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Make a label map of an image, and list its regions.

    The list has the area of each region, and its name and score where the method knows them.
    """
    from kcgs.data import load_image, overlay_labels, save_image, save_labels
    from kcgs.segment import segment_with_scores

    check_output(output, ".png", ".npy")
    if overlay is not None:
        check_output(overlay, *WRITTEN_IMAGES, name="overlay")
    options = _parse_options(option or [])
    if box is not None:
        options["box"] = _parse_numbers("box", "X0,Y0,X1,Y1", box)
    for key, points in (("foreground", foreground), ("background", background)):
        if points:
            options[key] = [_parse_numbers(key, "X,Y", point) for point in points]
    target = load_image(image)
    with Progress("finding regions", pulse=True, visible=not quiet):
        labels, scores, names = segment_with_scores(target, method, **options)
    save_labels(output, labels)
    if overlay is not None:
        save_image(overlay, overlay_labels(target, labels, ids=True))
    table = []
    for region, area in enumerate(labels.flatten().bincount().tolist()):
        name = None if names is None else names[region]
        score = None if scores is None else float(scores[region])
        table.append(replace_undefined({"id": region, "area": area, "name": name, "score": score}))
    report: dict[str, Any] = {"regions": len(table), "method": method}
    if as_json:
        report["table"] = table
    else:
        for row in table:
            facts = [f"{row['area']} pixels", row["name"], row["score"] is not None and f"score {row['score']:.2f}"]
            report[f"region {row['id']}"] = ", ".join(filter(None, facts))
    print_report(report, as_json, str(output))


def _parse_numbers(option: str, expected: str, text: str) -> list[float]:
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != expected.count(",") + 1:
        raise InvalidArgument(option, f"{expected} in pixels", repr(text))
    return numbers


def _parse_options(pairs: list[str]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not (equals and key.isidentifier()):
            raise InvalidArgument("option", "KEY=VALUE", repr(pair))
        try:
            options[key] = json.loads(text)
        except json.JSONDecodeError:
            options[key] = text
    return options
