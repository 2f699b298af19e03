"""What `kcgs fit` does with its output: a scene, or a compressed file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fit import FitConfig, FitResult
    from kcgs.functional import RegionMap
    from kcgs.nn import GaussianField

# dB that rounding lies below the error of the fit, so that it costs a tenth of a dB
_BELOW_THE_FIT = 14.5


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
) -> Fitted:
    """Fit, and write the scene or the compressed file, as the suffix says."""
    from kcgs._atomic import atomic_path
    from kcgs.codec import QUALITIES, decode
    from kcgs.fit import compress, fit, fit_bytes
    from kcgs.io import save

    if target_bytes is not None:
        done = fit_bytes(picture, labels, target_bytes, seed=seed, config=config, on_step=on_step)
        data, result = done.data, done.result
    else:
        result = fit(
            picture, labels, num_gaussians,
            seed=seed, config=config, on_step=on_step, checkpoint=checkpoint, resume=resume,
        )  # fmt: skip
        if output.suffix != ".kcgs":
            written = save(output, result.field, result.regions, metadata={"recipe": recipe})
            return Fitted(result, result.field, result.regions, written)
        psnr = max(entry.psnr for entry in result.history)
        quality = min(max(psnr + _BELOW_THE_FIT, QUALITIES[0]), QUALITIES[1])
        data = compress(result.field, picture, result.regions, quality=quality, seed=seed)
    with atomic_path(output) as temporary:
        temporary.write_bytes(data)
    decoded = decode(data)
    return Fitted(result, decoded.field, decoded.regions, len(data))
