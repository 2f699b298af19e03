"""Commands that take scenes out of Python: export, view, models."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from .common import Json, SceneFile, app, check_output, print_report


class Kind(str, Enum):
    """Kinds of decoder."""

    scene = "scene"
    generic = "generic"


class Precision(str, Enum):
    """Types that numbers are stored as."""

    fp32 = "fp32"
    fp16 = "fp16"


@app.command()
def export(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="ONNX file to write.")],
    kind: Annotated[
        Kind, typer.Option(help="scene: this scene's decoder; generic: one that takes any scene's numbers.")
    ] = Kind.scene,
    precision: Annotated[
        Precision,
        typer.Option(
            help="fp16 stores factors and colours in 16 bits, where no value of the picture changes by 1/255."
        ),
    ] = Precision.fp32,
    cutoff: Annotated[float, typer.Option(help="Weights below it are skipped.")] = 1e-4,
    clamp: Annotated[bool, typer.Option("--clamp", help="Clip the picture to [0, 1].")] = False,
    interactive: Annotated[
        bool, typer.Option("--interactive", help="With inputs for the part that is drawn and for regions to hide.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a scene's decoder as ONNX: it needs no torch and no kcgs."""
    from kcgs.io import load
    from kcgs.onnx import describe_decoder, generic_decoder, scene_decoder, write_model

    check_output(output, ".onnx")
    loaded = load(scene)
    if kind is Kind.generic:
        if interactive or precision is Precision.fp16:
            raise typer.BadParameter("--interactive and --precision are for --kind scene")
        regions = loaded.regions
        if regions is not None and regions.num_regions > 1 and (regions.softness != 0.0 or regions.supersample > 1):
            raise ValueError("--kind generic draws hard contours of whole pixels; this scene's are soft or finer")
        model = generic_decoder(cutoff=cutoff, clamp=clamp)
    else:
        model = scene_decoder(loaded, cutoff=cutoff, clamp=clamp, precision=precision.value, interactive=interactive)
    written = write_model(model, output)
    facts = describe_decoder(model)
    print_report({**facts, "bytes": written} if as_json else _readable(facts, written), as_json, str(output))


def _readable(facts: dict[str, object], written: int) -> dict[str, object]:
    left_out = facts["left_out"]
    assert isinstance(left_out, list)
    shown = {key: value for key, value in facts.items() if not isinstance(value, list)}
    return {**shown, "bytes": written, "left out": "\n".join(left_out)}


@app.command()
def view(
    scene: SceneFile,
    original: Annotated[Path | None, typer.Option(help="Image to compare with.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open a browser window.")] = True,
) -> None:
    """Look at a scene in the browser: zoom, compare, hide regions. Ends with Ctrl-C."""
    from kcgs.io import load
    from kcgs.view import serve

    loaded = load(scene)
    serve(
        loaded.field,
        loaded.regions,
        name=scene.stem,
        original=original,
        port=port,
        browser=browser,
        say=typer.echo,
    )


@app.command()
def models(as_json: Json = False) -> None:
    """List the fitted scenes of a checkout; every command that reads a scene takes them as zoo:NAME."""
    from kcgs.zoo import entries

    for_people = {e.name: f"{e.title}; {e.psnr:.2f} dB, {e.bytes} bytes" for e in entries()}
    print_report({e.name: e._asdict() for e in entries()} if as_json else for_people, as_json, "zoo")
