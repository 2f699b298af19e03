"""The job that `kcgs fit-many` runs for each batch of images, in any process: a file for each image."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .common import describe_error
from .many_fingerprints import FitJob, existing_row, fingerprint_of, is_done, mark_started, write_row
from .options import FitRequest, read_regions
from .reports import replace_undefined, report_fit
from .saving import SavedFit, fit_and_save, save_result

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fitting import FitResult


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
        """Fit the images, those of one shape together, and write their scenes and rows, unless both exist unchanged.

        An error of one image is returned; it does not stop the other images.
        """
        outcomes: dict[int, Outcome] = {}
        groups: dict[Any, dict[int, tuple[Loaded, str]]] = {}
        for index, job in enumerate(self.images):
            try:
                fingerprint = fingerprint_of(job)
                if (row := existing_row(job, fingerprint)) is not None:
                    outcomes[index] = Outcome(row, False)
                    continue
                loaded = load_job(job)
                mark_started(job, fingerprint)
                groups.setdefault((loaded.image.shape, loaded.labels is None), {})[index] = loaded, fingerprint
            except Exception as error:
                outcomes[index] = failure(error)
        for group in groups.values():
            outcomes |= _fit_group(self.images, group)
        return [outcomes[index] for index in range(len(self.images))]

    def count_done(self) -> int:
        """Count the images whose scenes and rows exist, from the same image, mask and settings."""
        return sum(map(is_done, self.images))


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
                scene_and_size = save_result(job.output, loaded.image, fit.result, job.request)
                saved_fit = SavedFit(fit.result, *scene_and_size, fit.seconds)
            report = report_fit(saved_fit, loaded.image, loaded.labels, job.output, job.request)
        row = {**replace_undefined(report), "fingerprint": fingerprint}
        write_row(job, row)
        fit_warnings = () if fit is None else fit.warnings
        return Outcome(row, True, (*loaded.warnings, *fit_warnings, *(str(message.message) for message in messages)))
    except Exception as error:
        return failure(error)


def failure(error: Exception) -> Outcome:
    """Return the outcome of a job that an error stopped."""
    return Outcome({"error": describe_error(error)}, True)
