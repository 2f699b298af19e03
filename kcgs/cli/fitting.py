"""What fits have in common, of one image or of many: regions in, a scene or a compressed file out, and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .common import write_file
from .segmentation import misalignment

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fit import FitConfig, FitResult
    from kcgs.functional import RegionMap
    from kcgs.nn import GaussianField


class Fitted(NamedTuple):
    """A fit, and what was written of it."""

    result: FitResult
    field: GaussianField
    """As it is in the file."""
    regions: RegionMap | None
    written: int
    """Bytes."""


def fit_into(
    output: Path,
    picture: Tensor,
    labels: Tensor | None,
    num_gaussians: int,
    target_bytes: int | None,
    *,
    recipe: str,
    seed: int,
    config: FitConfig,
    on_step: Any,
    checkpoint: Path | None,
    resume: bool,
    notes: Mapping[str, str] | None = None,
) -> Fitted:
    """Fit, and write the scene, with notes in it, or the compressed file, as the suffix says."""
    from kcgs.codec import decode
    from kcgs.fit import fit
    from kcgs.io import save
    from kcgs.rate import compress, fit_bytes, quality_for

    if target_bytes is not None:
        done = fit_bytes(picture, labels, target_bytes, seed=seed, config=config, on_step=on_step)
        write_file(output, done.data)
        return Fitted(done.result, done.field, done.regions, len(done.data))
    result = fit(
        picture, labels, num_gaussians,
        seed=seed, config=config, on_step=on_step, checkpoint=checkpoint, resume=resume,
    )  # fmt: skip
    if output.suffix != ".kcgs":
        written = save(output, result.field, result.regions, metadata={"recipe": recipe, **(notes or {})})
        return Fitted(result, result.field, result.regions, written)
    psnr = max(entry.psnr for entry in result.history)
    data = compress(result.field, picture, result.regions, quality=quality_for(psnr), seed=seed)
    write_file(output, data)
    decoded = decode(data)
    return Fitted(result, decoded.field, decoded.regions, len(data))


def read_regions(regions: str, picture: Tensor, warn: Callable[[str], None]) -> Tensor | None:
    """Return the label map that the option --regions names: a file's, one found in the picture, or none.

    Args:
        regions: a file, auto or none.
        picture: (C, H, W).
        warn: called with a sentence where the file's contours do not seem to be the picture's.
    """
    if regions == "none":
        return None
    if regions == "auto":
        from kcgs.segment import segment as make_labels

        return make_labels(picture)
    from kcgs.data import load_labels

    labels = load_labels(Path(regions))
    doubt = misalignment(picture, labels, regions)
    if doubt is not None:
        warn(doubt)
    return labels


def measure_scene(
    field: Any,
    regions: RegionMap | None,
    picture: Tensor,
    labels: Tensor | None,
    seconds: float | None,
    written: int,
) -> dict[str, Any]:
    """Draw a scene and compare it with the picture: what `fit` and `eval` print.

    Args:
        field: the Gaussians.
        regions: what they are drawn with.
        picture: (C, H, W), what should be seen.
        labels: whose contours the edge-focused figures look at.
        seconds: of the fit; None: of the drawing.
        written: bytes of the file.
    """
    import time

    from kcgs.bench.measure import measure
    from kcgs.nn.renderer import render_image

    start = time.perf_counter()
    drawn = render_image(field, regions)
    seconds = time.perf_counter() - start if seconds is None else seconds
    height, width = field.size
    return {
        **measure(drawn, picture, labels),
        "num_gaussians": len(field),
        "regions": 1 if regions is None else regions.num_regions,
        "seconds": seconds,
        "bytes": written,
        "bits_per_pixel": 8 * written / (height * width),
    }
