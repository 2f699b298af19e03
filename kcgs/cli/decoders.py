"""Commands around scenes: export, view, models."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .common import Json, SceneFile, app, check_output, print_report
from .options import Contours


@app.command()
def export(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="ONNX file to write, or .html: one web page.")],
    cutoff: Annotated[float, typer.Option(help="Weights below it are skipped.")] = 1e-4,
    clamp: Annotated[bool, typer.Option("--clamp/--no-clamp", help="Clip the image to [0, 1].")] = True,
    interactive: Annotated[
        bool, typer.Option("--interactive", help="With inputs for the part that is rendered and for regions to hide.")
    ] = False,
    contours: Contours = "scaled",
    as_json: Json = False,
) -> None:
    """Write a scene's decoder as ONNX, or the scene as one web page: neither needs torch or kcgs."""
    from kcgs import load
    from kcgs.onnx import describe_decoder, scene_decoder, write_model

    check_output(output, ".onnx", ".html")
    if output.suffix == ".html":
        if cutoff != 1e-4 or not clamp or interactive:
            raise typer.BadParameter("a page takes --contours only; the other options are for .onnx")
        print_report(_write_page(scene, output, contours), as_json, str(output))
        return
    model = scene_decoder(load(scene), cutoff=cutoff, clamp=clamp, interactive=interactive, contours=contours)
    report = {**describe_decoder(model), "bytes": write_model(model, output)}
    print_report(report, as_json, str(output))


def _write_page(path: Path, output: Path, contours: str) -> dict[str, object]:
    """Write the page of a scene; a `.kcgs` file is kept as it is."""
    from kcgs import load
    from kcgs._atomic import atomic_path
    from kcgs.page.html import scene_page, web_bytes
    from kcgs.scene import check_unbatched

    shown = check_unbatched(load(path))
    data = web_bytes(path.read_bytes() if path.suffix == ".kcgs" else shown)
    with atomic_path(output) as temporary:
        temporary.write_text(scene_page(data, title=output.stem, contours=contours), encoding="utf-8")
        size = temporary.stat().st_size
    height, width = shown.size
    return {
        "width": width, "height": height, "num_gaussians": shown.num_gaussians, "contours": contours,
        "scene_bytes": len(data), "bytes": size,
    }  # fmt: skip


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
