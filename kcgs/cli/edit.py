"""The command that edits a scene by region."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcgs._suffixes import SCENES
from kcgs.errors import InvalidArgument

from .commands import app
from .common import Json, SceneFile, check_output
from .options import exclude
from .reports import describe_file, describe_scene, print_report

if TYPE_CHECKING:
    from kcgs.scene import Scene


@app.command()
def edit(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene to write (.safetensors), or file (.kcgs).")],
    delete: Annotated[list[int] | None, typer.Option(metavar="ID", help="Delete a region.")] = None,
    recolor: Annotated[
        list[str] | None,
        typer.Option(metavar="ID=COLOR", help="Give a region the colour COLOR, such as #ff0000, with its shading."),
    ] = None,
    move: Annotated[
        list[str] | None,
        typer.Option(metavar="ID=DX,DY", help="Move a region by whole pixels, to the right and down."),
    ] = None,
    no_fill: Annotated[
        bool, typer.Option("--no-fill", help="Do not paint what is uncovered anew: it shows streaks, or black.")
    ] = False,
    margin: Annotated[
        int | None, typer.Option(min=0, help="Pixels around a hole that are painted anew, too; 6 by default.")
    ] = None,
    strength: Annotated[
        float | None, typer.Option(min=0, max=1, help="Share of the new colour of --recolor; 0.75 by default.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Delete, recolour and move regions of a scene, in this order; options may be repeated. `info` lists the regions.

    Of a batch of scenes, all frames are edited. A .kcgs file has the quality that `encode` has by default.
    """
    check_output(output, *SCENES)
    if not (delete or recolor or move):
        raise typer.BadParameter("an edit needs --delete, --recolor or --move")
    colors = [_parse("recolor", "ID=COLOR, such as 2=#ff0000", text) for text in recolor or []]
    offsets = [_parse_move(text) for text in move or []]
    if not (delete or move):
        exclude("--recolor alone", no_fill=no_fill or None, margin=margin)
    if not recolor:
        exclude("an edit without --recolor", strength=strength)
    from kcgs import editing, load, video

    edited = load(scene)
    hole: dict[str, Any] = {"fill": not no_fill} | _set_options(margin=margin)
    delete_region: Any = partial(editing.delete_region, **hole)
    move_region: Any = partial(editing.move_region, **hole)
    if edited.num_images is not None:
        exclude("a batch of scenes", no_fill=no_fill or None, margin=margin)
        check_output(output, ".safetensors")
        delete_region, move_region = video.delete_from_video, video.move_in_video
    if delete:
        edited = _apply("delete", delete_region, edited, delete)
    for region, color in colors:
        edited = _apply(
            "recolor", editing.recolor_region, edited, region, color=color, **_set_options(strength=strength)
        )
    for region, offset in offsets:
        edited = _apply("move", move_region, edited, region, offset)
    size = edited.save(output)
    print_report({**describe_scene(edited), **describe_file(output, size, edited.size)}, as_json, str(output))


def _set_options(**options: object) -> dict[str, Any]:
    """Return the options that have a value; for the others the function's defaults hold."""
    return {name: value for name, value in options.items() if value is not None}


def _parse(option: str, expected: str, text: str) -> tuple[int, str]:
    region, equals, value = text.partition("=")
    if not (equals and region.strip().isdecimal()):
        raise InvalidArgument(option, expected, repr(text))
    return int(region), value.strip()


def _parse_move(text: str) -> tuple[int, tuple[float, float]]:
    expected = "ID=DX,DY in pixels, such as 1=40,0"
    region, value = _parse("move", expected, text)
    try:
        dx, dy = map(float, value.split(","))
    except ValueError as error:
        raise InvalidArgument("move", expected, repr(text)) from error
    return region, (dx, dy)


def _apply(option: str, function: Callable[..., Scene], *arguments: object, **settings: object) -> Scene:
    """Edit a scene; report an error of an edit's argument as an error of the option."""
    try:
        return function(*arguments, **settings)
    except InvalidArgument as error:
        if error.name == "scene":
            raise
        raise InvalidArgument(option, error.expected, error.received, error.verb) from error
