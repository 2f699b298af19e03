"""From a picture to a file of so many bytes: how many Gaussians, how finely rounded, and whether contours pay."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count
from kcgs.codec import QUALITIES, decode
from kcgs.codec.encode import SceneWriter
from kcgs.codec.gaussians.quantize import QPS, Parameters, Quantizer
from kcgs.fit.config import FitConfig
from kcgs.fit.loop import check_problem, fit
from kcgs.fit.state import FitResult, HistoryEntry
from kcgs.functional import RegionMap, merge_regions
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .fine_tune import FineTuning

# a Gaussian whose whole energy is below this many times the distortion costs more bits than it saves: at the best rate
# a bit saves 2 ln 2 D for each number, and a Gaussian has about 30
_PAYING = 20.0
# bits of a Gaussian where rounding costs half a dB, at `_COUNT` of them, and for each doubling
_BITS, _COUNT, _BITS_AN_OCTAVE = 31.0, 2100, 1.9
_HEADER_BYTES = 60
# squared error falls with the power of the bytes
_POWER = 0.93
# contours show: a picture with them may have this much more squared error, 0.1 dB
_FAVOUR = 1.023
_TRIAL_ITERATIONS, _TRIAL_TO_END = 80, 0.65
# dB of a file's image against the scene's own above the scene's PSNR: the error grows by about a 28th, 0.15 dB,
# and by more where so few Gaussians are rounded that errors do not average out
_MARGIN = 14.5
# coded lengths vary by so much as Gaussians are tuned
_SLACK = 0.997


class Compressed(NamedTuple):
    """A file and what it was made from."""

    data: bytes
    field: GaussianField
    """As decoded."""
    regions: RegionMap | None
    result: FitResult
    """The fit, before rounding."""


@torch.inference_mode(False)
@torch.enable_grad()
def compress(
    field: GaussianField,
    image: Tensor,
    regions: RegionMap | Tensor | None = None,
    *,
    quality: float | None = None,
    target_bytes: int | None = None,
    iterations: int = 100,
    seed: int = 0,
) -> bytes:
    """Write a scene as a `.kcgs` file, rounded with an eye on the image that it shows.

    Gaussians are rounded a few at a time, and those that are still free make up for it: about a third less error than
    :func:`kcgs.codec.encode` at the same bytes. Those too faint to pay for their bits are left out.

    Args:
        field: N Gaussians of one image; opacities are merged into the colours.
        image: :math:`(C, H, W)` or :math:`(1, C, H, W)` in [0, 1], of the field's size and channels.
        regions: the map to draw with; None: one region.
        quality: as in :func:`kcgs.codec.encode`, before the others make up for it.
        target_bytes: the finest file that is not larger, in place of `quality`.
        iterations: drawings that the descent may take, at least 1.
        seed: of the order in which Gaussians are rounded.

    Returns:
        The file.

    Raises:
        TypeError, ValueError: as :func:`kcgs.codec.encode`; an image that does not fit the field; `iterations` below 1.

    Example:
        >>> from kcgs.codec import decode
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> field = fit(image, num_gaussians=20, config=FitConfig.from_recipe("best", iterations=50)).field
        >>> len(compress(field, image, target_bytes=150)) <= 150
        True
    """
    writer = SceneWriter(Scene(field, regions))
    image = _check_image(image, field)
    check_count("iterations", iterations)

    def write(qp: int, steps: int) -> bytes:
        quantizer = Quantizer(qp, writer.size)
        kept = _pays(writer.gaussians, quantizer)
        gaussians = Parameters(*(numbers[kept] for numbers in writer.gaussians))
        ids = None if field.region_ids is None else field.region_ids.cpu()[torch.from_numpy(kept)]
        tuning = FineTuning(gaussians, ids, image, writer.regions, quantizer, seed)
        return writer.write(quantizer, tuning.run(steps), writer.ids[kept])

    qp = writer.qp_for(quality, target_bytes)
    if target_bytes is None:
        return write(qp, iterations)
    highest, plain = writer.finest(lambda qp: write(qp, 0), target_bytes, share=_SLACK)
    for qp in range(highest, QPS[0] - 1, -1):
        data = write(qp, iterations)
        if len(data) <= target_bytes:
            return data
    return plain


def fit_bytes(
    image: Tensor,
    regions: RegionMap | Tensor | None = None,
    target_bytes: int = 8000,
    *,
    recipe: str = "best",
    seed: int = 0,
    config: FitConfig | None = None,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
) -> Compressed:
    """Fit an image to a budget of bytes, everything included.

    One trade decides: what the last bit saves. The number of Gaussians is that at which another one, or more digits
    for all, would save as much; a pixel of contour must save what the bits that the coder needs for it would save as
    Gaussians, else it moves or its regions unite; and the map as a whole stays only where two short fits, with it and
    with Gaussians for its bytes, say so, within 0.1 dB.

    Args:
        image: as in :func:`kcgs.fit.fit`.
        regions: as there.
        target_bytes: the file is not larger.
        recipe: as there.
        seed: as there.
        config: as there; its price of contours is replaced by the coder's, and `max_seconds` is for the fit alone,
            without the trials and the rounding.
        on_step: as there, for the fit itself, not the trials.

    Returns:
        The file, what it decodes to, and the fit.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit.fit`; a target too small for a Gaussian and the map.

    Example:
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> done = fit_bytes(image, None, 200, config=FitConfig.from_recipe("best", iterations=50))
        >>> len(done.data) <= 200, done.regions
        (True, None)
    """
    config = FitConfig.from_recipe(recipe) if config is None else config
    image, regions = check_problem(image, regions)
    check_count("target_bytes", target_bytes)
    regions, price = _choose(image, regions, target_bytes, config, seed)
    count = count_for(target_bytes - _map_bytes(regions))
    config = config.model_copy(update={"contour_cost": price})
    result = fit(image, regions, count, seed=seed, config=config, on_step=on_step)
    data = compress(result.field, image, result.regions, target_bytes=target_bytes, seed=seed)
    decoded = decode(data)
    return Compressed(data, decoded.field, decoded.regions, result)


def quality_for(psnr: float) -> float:
    """Return the `quality` of a file that is nearly as good as its scene.

    Args:
        psnr: of the scene's render against the image, in dB.

    Example:
        >>> quality_for(30.0), quality_for(100.0)
        (44.5, 90.0)
    """
    return min(max(psnr + _MARGIN, QUALITIES[0]), QUALITIES[1])


def count_for(num_bytes: float) -> int:
    """Return how many Gaussians make the best of so many bytes."""
    bits = 8 * max(num_bytes - _HEADER_BYTES, 1)
    count = bits / _BITS
    for _ in range(4):
        count = bits / max(_BITS + _BITS_AN_OCTAVE * math.log2(max(count, 1.0) / _COUNT), 8.0)
    return max(1, round(count))


def _choose(
    image: Tensor, regions: RegionMap | None, target_bytes: int, config: FitConfig, seed: int
) -> tuple[RegionMap | None, float]:
    """Return the map, or None where its bytes do more as Gaussians, and what a pixel of contour must save."""
    if regions is None or regions.num_regions == 1:
        return None, config.contour_cost
    iterations = min(_TRIAL_ITERATIONS, config.iterations)
    # by iterations, so that the same arguments give the same file
    shorter = {"iterations": iterations, "max_seconds": None, "merge_regions": False, "refine_flat": False}
    trial = config.model_copy(update=shorter)

    def error(drawn: RegionMap | None, left: int) -> float:
        result = fit(image, drawn, count_for(left), seed=seed, config=trial)
        return float(10 ** (-max(entry.psnr for entry in result.history) / 10))

    without = error(None, target_bytes)
    # what a bit saves, where it is spent on Gaussians
    saved = _POWER * _TRIAL_TO_END * without * image.shape[-2] * image.shape[-1] / (8 * target_bytes)
    price = saved * _contour_bits(regions)
    if config.merge_regions and regions.softness == 0.0 and regions.supersample == 1:
        regions = RegionMap.from_labels(merge_regions(image, regions.labels, price))
    left = target_bytes - _map_bytes(regions)
    if regions.num_regions == 1 or count_for(left) < regions.num_regions:
        return None, price
    return (regions if error(regions, left) < _FAVOUR * without else None), price


def _contour_bits(regions: RegionMap) -> float:
    """Bits that the coder takes for a pixel of this map's contours."""
    labels = regions.fine_labels
    edges = int((labels[1:] != labels[:-1]).sum() + (labels[:, 1:] != labels[:, :-1]).sum())
    return 8 * _map_bytes(regions) / max(edges, 1)


def _map_bytes(regions: RegionMap | None) -> int:
    if regions is None or regions.num_regions == 1:
        return 0
    from kcgs.codec.labels import encode_map  # loads numba

    return len(encode_map(regions))


def _pays(gaussians: Parameters, quantizer: Quantizer) -> NDArray[np.bool_]:
    """Say which Gaussians pay for their bits; one at least."""
    _, cholesky, colors = (torch.from_numpy(numbers) for numbers in gaussians)
    area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(quantizer.size[0] * quantizer.size[1])
    energy = colors.square().sum(-1) * area
    kept = energy >= _PAYING * quantizer.distortion
    kept[energy.argmax()] = True
    return kept.numpy()


def _check_image(image: Tensor, field: GaussianField) -> Tensor:
    image, _ = check_problem(image, None)
    if tuple(image.shape) != (field.colors.shape[-1], *field.size):
        raise ValueError(f"image must have shape {(field.colors.shape[-1], *field.size)}; got {tuple(image.shape)}")
    return image.float().cpu()
