"""The commands export and view, which show scenes outside of kcgs, and models, which lists the scenes of the zoo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import write_file

from .commands import app
from .common import Json, SceneFile, check_output
from .options import exclude
from .reports import describe_scene, print_report


@app.command()
def export(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="ONNX file to write, or .html: one web page.")],
    interactive: Annotated[
        bool,
        typer.Option("--interactive", help="Of ONNX: add inputs for a view and for the visibility of each region."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a scene's decoder as ONNX, or the scene as one web page: neither needs torch or kcgs."""
    check_output(output, ".onnx", ".html")
    if output.suffix == ".html":
        exclude("a page", interactive=interactive or None)
    from kcgs import load
    from kcgs.onnx import describe_decoder, scene_decoder

    loaded = load(scene)
    if output.suffix == ".html":
        from kcgs.page import scene_page, web_bytes

        # a compressed file goes into the page unchanged
        data = web_bytes(scene.read_bytes() if scene.suffix == ".kcgs" else loaded)
        size = write_file(output, scene_page(data, title=output.stem))
        print_report({**describe_scene(loaded), "scene_bytes": len(data), "bytes": size}, as_json, str(output))
        return
    model = scene_decoder(loaded, interactive=interactive)
    report = {**describe_decoder(model), "bytes": write_file(output, model.SerializeToString())}
    print_report(report, as_json, str(output))


@app.command()
def view(
    scene: SceneFile,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open a browser window.")] = True,
) -> None:
    """Look at a scene in the browser: zoom, hide regions. Ends with Ctrl-C."""
    from kcgs import load
    from kcgs.page import scene_page, serve
    from kcgs.scene import check_unbatched

    loaded = check_unbatched(load(scene))
    content = scene.read_bytes() if scene.suffix == ".kcgs" else loaded
    page = scene_page(content, title=scene.stem)
    serve(page, port=port, browser=browser, say=typer.echo)


@app.command()
def models(as_json: Json = False) -> None:
    """List the fitted scenes that come with kcgs; every command that reads a scene takes them as zoo:NAME."""
    from kcgs.zoo import entries

    report: dict[str, Any] = {entry.name: entry._asdict() for entry in entries()}
    if not as_json:
        report = {name: "{title}; {psnr:.2f} dB, {bytes} bytes".format(**entry) for name, entry in report.items()}
    print_report(report, as_json, "zoo")
