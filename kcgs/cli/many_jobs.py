"""The job that `kcgs fit-many` runs for each image, in any process."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple

from kcgs._atomic import write_file

from .common import describe_error, replace_undefined
from .fit import fit_and_save, read_regions, report_fit
from .options import FitRequest


class FitJob(NamedTuple):
    """An image to be fitted, and how."""

    image: Path
    output: Path
    """Of the scene; its row of results.csv is in a JSON file beside it."""
    regions: str
    """auto, none, or the mask."""
    request: FitRequest
    overwrite: bool = False
    """Replace a scene of another image, mask or settings, or one that was changed since."""
    resize_regions: bool = False
    threshold: float | None = None
    """Of masks with soft edges."""


class Outcome(NamedTuple):
    """The result of a job."""

    row: dict[str, Any]
    """Of results.csv; its error alone, where the job failed."""
    is_new: bool
    """False: the scene was there from the same image, mask and settings."""
    warnings: tuple[str, ...] = ()


def fit_one(job: FitJob) -> Outcome:
    """Fit an image, write its scene and its row, unless they are there unchanged; an error is returned."""
    from kcgs.data import load_image

    record = job.output.with_suffix(".json")
    try:
        fingerprint = _fingerprint(job)
        if job.output.is_file():
            kept = _read_kept(job, fingerprint)
            if kept is not None:
                return Outcome(kept, False)
            is_unfinished = _read_row(record) == {"fingerprint": fingerprint}
            if not (is_unfinished or job.overwrite):
                problem = "made with other settings or changed since"
                raise FileExistsError(f"{job.output} exists, {problem}; --overwrite replaces it")
        # a warning of one image among many must say which image: the caller does
        with warnings.catch_warnings(record=True) as messages:
            warnings.simplefilter("always", UserWarning)
            image = load_image(job.image)
            labels = read_regions(job.regions, image, job.threshold, resize=job.resize_regions)
            # a command that is killed between scene and row knows the scene as its own when it is run again
            write_file(record, json.dumps({"fingerprint": fingerprint}))
            saved_fit = fit_and_save(job.output, image, labels, job.request)
            report = report_fit(saved_fit, image, labels, job.output, job.request)
            row = {**replace_undefined(report), "fingerprint": fingerprint}
        write_file(record, json.dumps({**row, "checksum": _checksum(job.output, row)}))
        return Outcome(row, True, tuple(str(message.message) for message in messages))
    except Exception as error:
        return Outcome({"error": describe_error(error)}, True)


def is_done(job: FitJob) -> bool:
    """Return whether the scene is there, from the same image, mask and settings, and its row."""
    try:
        return _read_kept(job, _fingerprint(job)) is not None
    except OSError:
        return False


def _read_kept(job: FitJob, fingerprint: str) -> dict[str, Any] | None:
    """Return the row beside a scene that was made from the same and not changed since; None: there is none."""
    row = _read_row(job.output.with_suffix(".json"))
    checksum = row.pop("checksum", None)
    is_same = row.get("fingerprint") == fingerprint and checksum == _checksum(job.output, row)
    return row if is_same else None


def _read_row(record: Path) -> dict[str, Any]:
    """Read the row beside a scene; it is empty if there is none that can be read."""
    try:
        row = json.loads(record.read_bytes())
    except (FileNotFoundError, ValueError):
        return {}
    return row if isinstance(row, dict) else {}


def _checksum(output: Path, row: dict[str, Any]) -> str:
    """Hash a scene and its row."""
    return hashlib.sha256(output.read_bytes() + json.dumps(row).encode()).hexdigest()


def _fingerprint(job: FitJob) -> str:
    """Hash the image, the mask and all settings."""
    request = job.request
    settings: tuple[Any, ...] = (
        request.load_config().model_dump_json(), request.num_gaussians, request.target_bytes, request.seed,
    )  # fmt: skip
    if job.threshold is not None:
        settings += (job.threshold,)
    mask = job.regions.encode() if job.regions in ("auto", "none") else Path(job.regions).read_bytes()
    return hashlib.sha256(b"\0".join((repr(settings).encode(), job.image.read_bytes(), mask))).hexdigest()
