"""A scene and its image in, a file out: Gaussians that do not pay for their bits go, the others are fine tuned."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs._check import as_image, check_count
from kcgs.codec import QUALITIES, decode
from kcgs.codec.encode import SceneWriter
from kcgs.codec.gaussians.quantize import QPS, Parameters, Quantizer
from kcgs.scene import Scene

from .fine_tune import FineTuning

# a Gaussian whose whole energy is below this many times the distortion costs more bits than it saves: at the best rate
# a bit saves 2 ln 2 D for each number, and a Gaussian has about 30
_PAYING = 20.0
# dB of a file's image against the scene's own above the scene's PSNR: the error grows by about a 28th, 0.15 dB,
# and by more where so few Gaussians are rounded that errors do not average out
_MARGIN = 14.5
# coded lengths vary by so much as Gaussians are tuned
_SLACK = 0.997


class Compressed(NamedTuple):
    """A file, and the scene that it decodes to."""

    data: bytes
    scene: Scene


@torch.inference_mode(False)
@torch.enable_grad()
def compress(
    scene: Scene,
    image: Any,
    *,
    quality: float | None = None,
    target_bytes: int | None = None,
    iterations: int = 100,
    seed: int = 0,
) -> Compressed:
    """Write a scene as a `.kcgs` file, rounded with an eye on the image that it shows.

    Gaussians are rounded a few at a time, and those that are still free make up for it: about a third less error than
    :func:`kcgs.codec.encode` at the same bytes. Those too faint to pay for their bits are left out.

    Args:
        scene: N Gaussians of one image; opacities are merged into the colours, and notes are not kept.
        image: what :func:`kcgs.fit.fit` takes, of the scene's size and channels.
        quality: as in :func:`kcgs.codec.encode`, before the others make up for it.
        target_bytes: the finest file that is not larger, in place of `quality`.
        iterations: renders that the descent may take, at least 1.
        seed: of the order in which Gaussians are rounded.

    Returns:
        The file, and the scene that it decodes to.

    Raises:
        TypeError, ValueError: as :func:`kcgs.codec.encode`; an image that does not fit the scene; `iterations` below 1.

    Example:
        >>> from kcgs import fit
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> scene = fit(image, num_gaussians=20, iterations=50).scene
        >>> len(compress(scene, image, target_bytes=150).data) <= 150
        True
    """
    writer = SceneWriter(scene)
    target = as_image("image", image)
    if tuple(target.shape) != (writer.channels, *writer.size):
        raise ValueError(f"image must have shape {(writer.channels, *writer.size)}; got {tuple(target.shape)}")
    # a copy: an inference tensor cannot take part in a graph
    target = target.detach().to("cpu", torch.float32, copy=True)
    qp = writer.qp_for(quality, target_bytes)
    check_count("iterations", iterations)

    def write(qp: int, steps: int) -> bytes:
        quantizer = Quantizer(qp, writer.size)
        kept = _pays(writer.gaussians, quantizer)
        gaussians = Parameters(*(numbers[kept] for numbers in writer.gaussians))
        region_ids = None if writer.regions is None else writer.regions.ids[torch.from_numpy(writer.ids[kept])]
        tuning = FineTuning(gaussians, region_ids, target, writer.regions, quantizer, seed)
        return writer.write(quantizer, tuning.run(steps), writer.ids[kept])

    if target_bytes is None:
        data = write(qp, iterations)
    else:
        highest, data = writer.finest(lambda qp: write(qp, 0), target_bytes, share=_SLACK)
        tuned = (write(qp, iterations) for qp in range(highest, QPS[0] - 1, -1))
        data = next((tried for tried in tuned if len(tried) <= target_bytes), data)
    return Compressed(data, decode(data).scene)


def quality_for(psnr: float) -> float:
    """Return the `quality` of a file that is nearly as good as its scene.

    Args:
        psnr: of the scene's render against the image, in dB.

    Example:
        >>> quality_for(30.0), quality_for(100.0)
        (44.5, 90.0)
    """
    return min(max(psnr + _MARGIN, QUALITIES[0]), QUALITIES[1])


def _pays(gaussians: Parameters, quantizer: Quantizer) -> NDArray[np.bool_]:
    """Say which Gaussians pay for their bits; one at least."""
    _, cholesky, colors = (torch.from_numpy(numbers) for numbers in gaussians)
    area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(quantizer.size[0] * quantizer.size[1])
    energy = colors.square().sum(-1) * area
    kept = energy >= _PAYING * quantizer.distortion
    kept[energy.argmax()] = True
    return kept.numpy()
