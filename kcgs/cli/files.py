"""Commands on the compressed file .kcgs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .common import IMAGES, Json, SceneFile, app, check_output, print_report, write_file

KcgsFile = Annotated[Path, typer.Argument(help="Compressed file (.kcgs).", metavar="FILE")]


@app.command("encode")
def encode_command(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write (.kcgs).")],
    target_bytes: Annotated[int | None, typer.Option(min=1, help="The finest file that is not larger.")] = None,
    quality: Annotated[
        float | None,
        typer.Option(help="PSNR in dB of the file's picture against the scene's; 46 where neither is given."),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option(help="The image that the scene shows: Gaussians then make up for each other's rounding."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compress a scene."""
    from kcgs.codec import decode, encode
    from kcgs.functional import psnr
    from kcgs.io import load
    from kcgs.nn.renderer import render_image

    check_output(output, ".kcgs")
    loaded = load(scene)
    goal: dict[str, Any] = {"quality": quality, "target_bytes": target_bytes}
    if image is None:
        data = encode(loaded.field, loaded.regions, **goal)
    else:
        from kcgs.data import load_image
        from kcgs.rate import compress

        data = compress(loaded.field, load_image(image), loaded.regions, **goal)
    write_file(output, data)
    decoded = decode(data)
    height, width = decoded.field.size
    shown = render_image(decoded.field, decoded.regions)
    report = {
        "psnr_to_scene": float(psnr(shown, render_image(loaded.field, loaded.regions))),
        "num_gaussians": len(decoded.field),
        "regions": 1 if decoded.regions is None else decoded.regions.num_regions,
        "layers": decoded.num_layers,
        "bytes": len(data),
        "bits_per_pixel": 8 * len(data) / (height * width),
        "bits_per_gaussian": 8 * len(data) / len(decoded.field),
    }
    print_report(report, as_json, str(output))


@app.command("decode")
def decode_command(
    file: KcgsFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Image file to write.")],
    num_bytes: Annotated[int | None, typer.Option("--bytes", min=1, help="Read only the first bytes.")] = None,
    scale: Annotated[float | None, typer.Option(help="Magnification.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Width and height in pixels.")] = None,
) -> None:
    """Draw a compressed file, or the coarser picture that its first bytes hold."""
    from kcgs.codec import CodecError, decode
    from kcgs.data import save_image
    from kcgs.nn.renderer import render_image

    from .commands import target_size

    check_output(output, *IMAGES)
    try:
        decoded = decode(file.read_bytes(), max_bytes=num_bytes)
    except CodecError as error:
        raise CodecError(f"cannot decode {file}: {error}") from error
    if decoded.layers < decoded.num_layers:
        held = f"{decoded.layers} of {decoded.num_layers} layers, {len(decoded.field)} Gaussians"
        typer.echo(f"{file}: a coarser picture, {held}", err=True)
    save_image(output, render_image(decoded.field, decoded.regions, target_size(decoded.field.size, scale, size)))
