"""What `kcgs fit-many` does with one image, in whichever process that happens."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple

from kcgs._atomic import write_file

from .common import clean
from .fit import fit_into, read_regions, report_fit
from .options import FitRequest


class Order(NamedTuple):
    """An image to be fitted, and how."""

    image: Path
    output: Path
    """Of the scene; its row of results.csv is in a JSON file beside it."""
    regions: str
    """auto, none, or the mask."""
    request: FitRequest


class Outcome(NamedTuple):
    """What became of an image."""

    row: dict[str, Any]
    """Of results.csv; with an error, where there is one."""
    is_new: bool
    """False: the scene was there from the same image, mask and settings."""
    warnings: tuple[str, ...] = ()


def fit_one(order: Order) -> Outcome:
    """Fit an image, write its scene and its row, unless they are there; an error is returned."""
    record = order.output.with_suffix(".json")
    try:
        fit = _fingerprint(order)
        if order.output.is_file() and record.is_file():
            row = json.loads(record.read_text(encoding="utf-8"))
            if row["fit"] == fit:
                return Outcome(row, False)
        # a warning of one image among many must say which image: the caller does
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            row = {**clean(_fit(order)), "fit": fit}
        write_file(record, json.dumps(row))
        return Outcome(row, True, tuple(str(warning.message) for warning in caught))
    except Exception as error:
        return Outcome({"error": " ".join(str(error).split()) or type(error).__name__}, True)


def _fit(order: Order) -> dict[str, Any]:
    from kcgs.data import load_image

    image = load_image(order.image)
    labels = read_regions(order.regions, image)
    fitted = fit_into(order.output, image, labels, order.request)
    return report_fit(fitted, image, labels, order.output, order.request)


def _fingerprint(order: Order) -> str:
    """Hash the image, the mask and all settings."""
    request = order.request
    settings = request.config.model_dump_json(), request.num_gaussians, request.target_bytes, request.seed
    mask = order.regions.encode() if order.regions in ("auto", "none") else Path(order.regions).read_bytes()
    return hashlib.sha256(b"\0".join((repr(settings).encode(), order.image.read_bytes(), mask))).hexdigest()
