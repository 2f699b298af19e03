"""What commands print: a table or one JSON object, with figures of scenes, files and fits."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from .options import FitRequest
from .saving import SavedFit

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.scene import Scene


def replace_undefined(report: dict[str, Any]) -> dict[str, Any]:
    """Replace NaN and infinity by None: JSON has no such numbers."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in report.items()}


def _explain_undefined(name: str) -> str:
    """Return the reason why a metric of `evaluate` is not defined."""
    from kcgs.functional import METRICS

    return f"not defined: {METRICS[name].undefined}" if name in METRICS else "not defined"


def print_report(report: dict[str, Any], as_json: bool, title: str) -> None:
    """Print a table, or one JSON object."""
    if as_json:
        typer.echo(json.dumps(replace_undefined(report)))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("", title)
    for key, value in report.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            table.add_row(key, _explain_undefined(key) if text == "nan" else text)
    Console(markup=False).print(table)


def report_fit(
    saved_fit: SavedFit, image: Tensor, labels: Tensor | None, output: Path, request: FitRequest
) -> dict[str, Any]:
    """Return the metrics of the file (EF metrics along the contours of `labels`), and how the fit ended."""
    from kcgs.evaluation import evaluate

    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # the table says it
        metrics = evaluate(saved_fit.scene, image, labels, with_ssimulacra2=False)
    target_psnr = request.load_config().target_psnr
    return {
        **metrics,
        **describe_scene(saved_fit.scene),
        "seconds": saved_fit.seconds,
        **describe_file(output, saved_fit.num_bytes, saved_fit.scene.size),
        "stop_reason": saved_fit.result.stop_reason,
        "target_reached": None if target_psnr is None else metrics["psnr"] >= target_psnr,
    }


def describe_scene(scene: Scene) -> dict[str, int]:
    """Return the numbers of Gaussians and of regions."""
    regions = 1 if scene.regions is None else scene.regions.num_regions
    return {"num_gaussians": scene.num_gaussians, "regions": regions}


def describe_file(path: Path, num_bytes: int, size: tuple[int, int]) -> dict[str, float | None]:
    """Return the size of a file in bytes, and the bits per pixel of a compressed file."""
    rate = 8 * num_bytes / (size[0] * size[1]) if path.suffix == ".kcgs" else None
    return {"bytes": num_bytes, "bits_per_pixel": rate}
