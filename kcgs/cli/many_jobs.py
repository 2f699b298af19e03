"""The job that `kcgs fit-many` runs for each batch of images, in any process: a file for each image."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from kcgs._atomic import write_file

from .common import describe_error
from .options import FitRequest, read_regions
from .reports import replace_undefined, report_fit
from .saving import SavedFit, fit_and_save, save_result

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fitting import FitResult


class FitJob(NamedTuple):
    """An image to be fitted, and the options of its fit."""

    image: Path
    output: Path
    """File of the scene; its row of results.csv is in a JSON file beside it."""
    regions: str
    """auto, none, or the path of the mask."""
    request: FitRequest
    overwrite: bool = False
    """Replace a scene that has another image, mask or settings, or that was changed since."""
    resize_regions: bool = False
    threshold: float | None = None
    """Threshold of masks with soft edges."""


class Outcome(NamedTuple):
    """The result of a job."""

    row: dict[str, Any]
    """Row of results.csv; only the error if the job failed."""
    is_new: bool
    """False: the scene already existed, from the same image, mask and settings."""
    warnings: tuple[str, ...] = ()


class Loaded(NamedTuple):
    """An image, its label map, and the warnings while they were read."""

    image: Tensor
    labels: Tensor | None
    warnings: tuple[str, ...]


class BatchFit(NamedTuple):
    """The fit of one image of a batch."""

    result: FitResult
    seconds: float
    """The time of the batch, divided by its number of images."""
    warnings: tuple[str, ...]


class FileBatch(NamedTuple):
    """Images that one job fits, with a file for each."""

    images: tuple[FitJob, ...]

    def run(self) -> list[Outcome]:
        """Fit the images whose scenes do not exist."""
        return fit_jobs(self.images)

    def count_done(self) -> int:
        """Count the images whose scenes and rows exist, from the same image, mask and settings."""
        return sum(map(_is_done, self.images))


def load_job(job: FitJob) -> Loaded:
    """Read the image of a job and its regions."""
    # among many images a warning must name its image: the caller adds the name
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always", UserWarning)
        image = job.request.load_image(job.image)
        labels = read_regions(job.regions, image, job.threshold, resize=job.resize_regions)
    return Loaded(image, labels, tuple(str(message.message) for message in messages))


def fit_batch(loaded: Sequence[Loaded], request: FitRequest) -> list[BatchFit]:
    """Fit images of one shape together."""
    import torch

    from kcgs.fitting import fit

    device = request.load_device()
    images = torch.stack([one.image for one in loaded]).to(device)
    maps = [one.labels for one in loaded if one.labels is not None]
    labels = torch.stack(maps).to(device) if maps else None
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of the batch; for images: _warnings_of
        result = fit(images, labels, request.num_gaussians, recipe=request.load_config(), seed=request.seed)
    seconds = result.seconds / len(loaded)
    parts = [result.of_image(k) for k in range(len(loaded))]
    count = request.count_for(*images.shape[-2:])
    return [BatchFit(part, seconds, _warnings_of(part, count)) for part in parts]


def _warnings_of(result: FitResult, count: int) -> tuple[str, ...]:
    """Return the warnings that a fit of this image alone would give."""
    from kcgs.fitting import describe_excess

    messages = ["the fit diverged: the best so far is kept"] if result.diverged else []
    report = result.regions
    if report is not None and not isinstance(report, list) and report.num_before > count and result.config.guidance:
        messages.append(describe_excess(report.num_before - count, report.num_before, count, result.config))
    return tuple(messages)


def fit_jobs(jobs: Sequence[FitJob]) -> list[Outcome]:
    """Fit images, those of the same shape together; write the scene and the row of each, unless both exist unchanged.

    An error of one image is returned; it does not stop the other images.
    """
    outcomes: dict[int, Outcome] = {}
    groups: dict[Any, dict[int, tuple[Loaded, str]]] = {}
    for index, job in enumerate(jobs):
        try:
            fingerprint = _fingerprint(job)
            if (row := _existing_row(job, fingerprint)) is not None:
                outcomes[index] = Outcome(row, False)
                continue
            loaded = load_job(job)
            # if the command is killed between scene and row, the next run recognizes the scene as its own
            write_file(job.output.with_suffix(".json"), json.dumps({"fingerprint": fingerprint}))
            groups.setdefault((loaded.image.shape, loaded.labels is None), {})[index] = loaded, fingerprint
        except Exception as error:
            outcomes[index] = _failure(error)
    for group in groups.values():
        outcomes |= _fit_group(jobs, group)
    return [outcomes[index] for index in range(len(jobs))]


def _fit_group(jobs: Sequence[FitJob], group: dict[int, tuple[Loaded, str]]) -> dict[int, Outcome]:
    """Fit images of the same shape together; if that fails, fit them one by one."""
    fits: dict[int, BatchFit] = {}
    if len(group) > 1:
        try:
            request = jobs[min(group)].request
            fits = dict(zip(group, fit_batch([loaded for loaded, _ in group.values()], request), strict=True))
        except Exception:  # one by one, the image at fault gives its own error
            fits = {}
    return {
        index: _finish_job(jobs[index], loaded, fingerprint, fits.get(index))
        for index, (loaded, fingerprint) in group.items()
    }


def _finish_job(job: FitJob, loaded: Loaded, fingerprint: str, fit: BatchFit | None) -> Outcome:
    """Write the scene and the row of an image; fit the image first if `fit` is None."""
    try:
        with warnings.catch_warnings(record=True) as messages:
            warnings.simplefilter("always", UserWarning)
            if fit is None:
                saved_fit = fit_and_save(job.output, loaded.image, loaded.labels, job.request)
            else:
                scene, num_bytes = save_result(job.output, loaded.image, fit.result, job.request)
                saved_fit = SavedFit(fit.result, scene, num_bytes, fit.seconds)
            report = report_fit(saved_fit, loaded.image, loaded.labels, job.output, job.request)
        row = {**replace_undefined(report), "fingerprint": fingerprint}
        write_file(job.output.with_suffix(".json"), json.dumps({**row, "checksum": _checksum(job.output, row)}))
        fit_warnings = () if fit is None else fit.warnings
        return Outcome(row, True, (*loaded.warnings, *fit_warnings, *(str(message.message) for message in messages)))
    except Exception as error:
        return _failure(error)


def _failure(error: Exception) -> Outcome:
    return Outcome({"error": describe_error(error)}, True)


def _is_done(job: FitJob) -> bool:
    try:
        return _valid_row(job, _fingerprint(job)) is not None
    except OSError:
        return False


def _existing_row(job: FitJob, fingerprint: str) -> dict[str, Any] | None:
    """Return the row of an unchanged scene, else None; without --overwrite, refuse to replace a file."""
    record = job.output.with_suffix(".json")
    if not job.output.is_file():
        if record.is_file() and "fingerprint" not in _read_row(record) and not job.overwrite:
            raise FileExistsError(f"{record} exists, and was not written by kcgs fit-many; --overwrite replaces it")
        return None
    row = _valid_row(job, fingerprint)
    is_unfinished = _read_row(record) == {"fingerprint": fingerprint}
    if row is None and not (is_unfinished or job.overwrite):
        problem = "made with other settings or changed since"
        raise FileExistsError(f"{job.output} exists, {problem}; --overwrite replaces it")
    return row


def _valid_row(job: FitJob, fingerprint: str) -> dict[str, Any] | None:
    """Return the row beside a scene if its fingerprint and checksum are right, else None."""
    row = _read_row(job.output.with_suffix(".json"))
    checksum = row.pop("checksum", None)
    is_same = row.get("fingerprint") == fingerprint and checksum == _checksum(job.output, row)
    return row if is_same else None


def _read_row(record: Path) -> dict[str, Any]:
    """Read the row beside a scene; return an empty row if there is no readable one."""
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
    mask = job.regions.encode() if job.regions in ("auto", "none") else Path(job.regions).read_bytes()
    return hashlib.sha256(b"\0".join((describe_settings(job).encode(), job.image.read_bytes(), mask))).hexdigest()


def describe_settings(job: FitJob) -> str:
    """Return all settings that a scene depends on, besides the image and the mask, as text."""
    request = job.request
    settings: tuple[Any, ...] = (
        request.load_config().model_dump_json(), request.num_gaussians, request.target_bytes, request.seed,
    )  # fmt: skip
    settings += ("grey",) if request.is_grey else ()
    return repr(settings if job.threshold is None else (*settings, job.threshold))
