"""Commands around scenes: export, view, models."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcgs._atomic import write_file

from .common import Json, SceneFile, app, check_output, print_report
from .fit import describe_scene
from .options import Contours


@app.command()
def export(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="ONNX file to write, or .html: one web page.")],
    interactive: Annotated[
        bool, typer.Option("--interactive", help="With inputs for the part that is rendered and for regions to hide.")
    ] = False,
    contours: Contours = "scaled",
    as_json: Json = False,
) -> None:
    """Write a scene's decoder as ONNX, or the scene as one web page: neither needs torch or kcgs."""
    check_output(output, ".onnx", ".html")
    from kcgs import load
    from kcgs.onnx import describe_decoder, scene_decoder

    loaded = load(scene)
    if output.suffix == ".html":
        from kcgs.page.html import scene_page, web_bytes

        if interactive:
            raise typer.BadParameter("a page takes --contours only; --interactive is for .onnx")
        # a compressed file is kept as it is
        data = web_bytes(scene.read_bytes() if scene.suffix == ".kcgs" else loaded)
        size = write_file(output, scene_page(data, title=output.stem, contours=contours))
        print_report({**describe_scene(loaded), "scene_bytes": len(data), "bytes": size}, as_json, str(output))
        return
    model = scene_decoder(loaded, interactive=interactive, contours=contours)
    report = {**describe_decoder(model), "bytes": write_file(output, model.SerializeToString())}
    print_report(report, as_json, str(output))


@app.command()
def view(
    scene: SceneFile,
    contours: Contours = "scaled",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open a browser window.")] = True,
) -> None:
    """Look at a scene in the browser: zoom, hide regions. Ends with Ctrl-C."""
    from kcgs import load
    from kcgs.page import scene_page
    from kcgs.page.server import serve
    from kcgs.scene import check_unbatched

    loaded = check_unbatched(load(scene))
    shown = scene.read_bytes() if scene.suffix == ".kcgs" else loaded
    page = scene_page(shown, title=scene.stem, contours=contours)
    serve(page, port=port, browser=browser, say=typer.echo)


@app.command()
def models(as_json: Json = False) -> None:
    """List the fitted scenes that come with kcgs; every command that reads a scene takes them as zoo:NAME."""
    from kcgs.zoo import entries

    for_people = {e.name: f"{e.title}; {e.psnr:.2f} dB, {e.bytes} bytes" for e in entries()}
    print_report({e.name: e._asdict() for e in entries()} if as_json else for_people, as_json, "zoo")
