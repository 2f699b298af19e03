"""The command fit."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from kcgs._suffixes import SCENES

from . import options
from .commands import app
from .common import ImageFile, InterruptHandler, Json, Quiet, check_new, check_output, exit_interrupted
from .reports import print_report, report_fit
from .saving import file_config, fit_and_save


@app.command("fit")
@options.with_fit_options
def fit_command(
    image: ImageFile,
    *,
    regions: Annotated[
        str,
        typer.Option(
            metavar="MASK|auto|none", help=f"Label-map file, or auto (segment the image, {options.IF_LARGE}), or none."
        ),
    ] = "auto",
    request: options.FitRequest,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Scene (.safetensors) or file (.kcgs); default: IMAGE's name, here."),
    ] = None,
    overwrite: options.Overwrite = False,
    threshold: options.Threshold = None,
    resize_regions: options.ResizeRegions = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to an image and save the scene. Ctrl-C saves the best so far.

    EF-PSNR and EF-SSIM are along the contours of the label map as it was before the fit; those of `eval` are along the
    scene's, which the fit may have moved. The seconds are those of the fit and of the writing of its file.
    """
    output = output or Path(f"{image.stem}{request.default_suffix}")
    check_output(output, *(SCENES if request.target_bytes is None else (".kcgs",)))
    check_new(output, overwrite)
    file_config(output, request)  # refuses wrong settings before the work
    request.load_device()  # and a device that torch lacks
    target = request.load_image(image)
    labels = options.read_regions(regions, target, threshold, resize=resize_regions, progress=not quiet)
    with InterruptHandler() as interrupts:
        saved_fit = fit_and_save(output, target, labels, request, on_step=interrupts.on_step, progress=not quiet)
    report, regions_report = report_fit(saved_fit, target, labels, output, request), saved_fit.result.regions
    assert not isinstance(regions_report, list)  # the image is no batch
    if interrupts.count:
        report["stop_reason"] = "interrupted"
    if as_json:
        report["region_report"] = None if regions_report is None else asdict(regions_report)
    print_report(report, as_json, str(output))
    if regions_report is not None and not as_json:
        is_lost = regions_report.num_before > 1 == regions_report.num_after and regions_report.dropped != "recipe"
        typer.echo(f"regions: {regions_report}{'. --keep-contours keeps them' if is_lost else ''}")
    if labels is None and regions == "auto" and not as_json:
        typer.echo(f"regions: none, for a side is below {options.LEAST_SIDE} pixels")
    if interrupts.count:
        raise exit_interrupted(f"the best so far to {output}")
    if report["target_reached"] is False:
        target_psnr, psnr = request.load_config().target_psnr, report["psnr"]
        typer.echo(f"kcgs: --target-psnr {target_psnr:g} was not reached: {psnr:.2f} dB is the best", err=True)
        raise typer.Exit(1)
