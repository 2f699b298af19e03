"""A scene and its image in, a file out: Gaussians that do not pay for their bits go, the others are fine tuned.

Gaussians overlap, so what rounding one of them does to the image its neighbours can partly undo, as long as they may
still move. So they are rounded a few at a time, shapes first and colours last, and those that are still free descend
meanwhile. A step is a gradient divided by the known curvature of the squared error (docs/format.md), with momentum.
"""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import as_image, check_count, check_number
from kcgs._repr import brief
from kcgs.codec import QUALITIES, decode
from kcgs.codec.gaussians.quantize import QPS, Codes, Parameters, Quantizer
from kcgs.codec.scenes import SceneWriter
from kcgs.fit.frame import local_gradient, move
from kcgs.fit.objective import VisualObjective
from kcgs.functional import RegionMap, psnr, region_splat
from kcgs.kernels import threads_for_kernels
from kcgs.scene import Scene

# a Gaussian whose whole energy is below this many times the distortion costs more bits than it saves: at the best rate
# a bit saves 2 ln 2 D for each number, and a Gaussian has about 30
_PAYING = 20.0
# dB of a file's image against the scene's own above the scene's PSNR: the error grows by about a 28th, 0.15 dB,
# and by more where so few Gaussians are rounded that errors do not average out
_MARGIN = 14.5
# dB by which files are finer that are tried until one is good enough
_FINER = (0.0, 2.0, 5.0, 9.0, 14.0, 20.0, 30.0, 50.0)
# coded lengths vary by so much as Gaussians are tuned
_SLACK = 0.997
# share of the iterations in which shapes are rounded; colours are in the rest
_SHAPES = 0.65
# of the seconds that are left, for the first of several files
_SHARE = 0.5
_STEP, _MOMENTUM = 0.09, 0.9
# the largest step, in standard deviations and in log scale; and the largest share of Newton's
_LARGEST, _NEWTON = 0.2, 0.3
# energies below it have next to no curvature: steps are as if they had this
_FAINT = 1e-2
# half the second derivatives of the squared error by a step in a Gaussian's frame, in units of its energy
_CURVATURE = (0.5, 0.5, 0.75, 0.25, 0.75)
_DRAFT_CUTOFF = 1e-3


@brief
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
    target_psnr: float | None = None,
    iterations: int = 250,
    max_seconds: float | None = None,
    seed: int = 0,
    objective: str = "psnr",
) -> Compressed:
    """Write a scene as a `.kcgs` file, rounded with an eye on the image that it shows.

    Gaussians are rounded a few at a time, and those that are still free make up for it: about a third less error than
    :func:`kcgs.codec.encode` at the same bytes. Those too faint to pay for their bits are left out.

    Args:
        scene: N Gaussians of one image; opacities are merged into the colours, and notes are not kept.
        image: what :func:`kcgs.fit.fit` takes, of the scene's size and channels.
        quality: as in :func:`kcgs.codec.encode`, before the others make up for it.
        target_bytes: the finest file that is not larger, in place of `quality`.
        target_psnr: dB against the image, in place of both: the first of ever finer files that shows it, or where the
            scene itself does not, one that is nearly as good.
        iterations: renders that the descent may take, at least 1.
        max_seconds: wall time, above 0; what it has no time for is rounded at once. None: as long as it takes.
        seed: of the order in which Gaussians are rounded.
        objective: of the descent, as in :class:`kcgs.fit.FitConfig`: psnr or visual.

    Returns:
        The file, and the scene that it decodes to.

    Raises:
        TypeError, ValueError: as :func:`kcgs.codec.encode`; an image that does not fit the scene; `iterations` below
            1, another `objective`.

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
    if target_psnr is not None and (quality is not None or target_bytes is not None):
        raise ValueError(f"target_psnr excludes quality and target_bytes; got {quality!r} and {target_bytes!r}")
    qp = writer.qp_for(quality, target_bytes)
    check_count("iterations", iterations)
    if objective not in ("psnr", "visual"):
        raise ValueError(f"objective must be psnr or visual; got {objective!r}")
    visual = VisualObjective(target) if objective == "visual" else None
    end = math.inf
    if max_seconds is not None:
        end = time.perf_counter() + check_number("max_seconds", max_seconds, 0.0, unit="seconds", above=True)

    def write(qp: int, steps: int, share: float = 1.0) -> bytes:
        quantizer = Quantizer(qp, writer.size)
        kept = _pays(writer.gaussians, quantizer)
        gaussians = Parameters(*(numbers[kept] for numbers in writer.gaussians))
        region_ids = None if writer.regions is None else writer.regions.ids[torch.from_numpy(writer.ids[kept])]
        tuning = _FineTuning(gaussians, region_ids, target, writer.regions, quantizer, seed, visual)
        with threads_for_kernels(target[0].numel()):
            tuned = tuning.run(steps, share * (end - time.perf_counter()))
        return writer.write(quantizer, tuned, writer.ids[kept])

    if target_psnr is not None:
        wanted = check_number("target_psnr", target_psnr, 0.0, unit="dB")
        reached = float(psnr(scene.render().to(target), target))
        for finer in _FINER if reached >= wanted else _FINER[:1]:
            data = write(writer.qp_for(quality_for(reached + finer)), iterations, _SHARE)
            if float(psnr(decode(data).scene.render(), target)) >= wanted:
                break
    elif target_bytes is None:
        data = write(qp, iterations)
    else:
        highest, data = writer.finest(lambda qp: write(qp, 0), target_bytes, share=_SLACK)
        tuned = (write(qp, iterations, _SHARE) for qp in range(highest, QPS[0] - 1, -1))
        data = next((tried for tried in tuned if len(tried) <= target_bytes), data)
    return Compressed(data, decode(data).scene)


def quality_for(decibels: float) -> float:
    """Return the `quality` of a file that is nearly as good as its scene.

    Args:
        decibels: PSNR of the scene's render against the image.

    Example:
        >>> quality_for(30.0), quality_for(100.0)
        (44.5, 90.0)
    """
    return min(max(decibels + _MARGIN, QUALITIES[0]), QUALITIES[1])


def _pays(gaussians: Parameters, quantizer: Quantizer) -> NDArray[np.bool_]:
    """Say which Gaussians pay for their bits; one at least."""
    _, cholesky, colors = (torch.from_numpy(numbers) for numbers in gaussians)
    area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(quantizer.size[0] * quantizer.size[1])
    energy = colors.square().sum(-1) * area
    kept = energy >= _PAYING * quantizer.distortion
    kept[energy.argmax()] = True
    return kept.numpy()


class _FineTuning:
    """Gaussians (float64) that are rounded a few at a time, in an order of the seed, to show an image (C, H, W)."""

    def __init__(
        self,
        gaussians: Parameters,
        region_ids: Tensor | None,
        image: Tensor,
        regions: RegionMap | None,
        quantizer: Quantizer,
        seed: int,
        objective: VisualObjective | None,
    ) -> None:
        self.objective = objective
        self.region_ids, self.image, self.regions, self.quantizer = region_ids, image, regions, quantizer
        self.classes = quantizer.classify(gaussians)
        self.free = [torch.from_numpy(numbers).to(image) for numbers in gaussians]
        count, channels = gaussians.colors.shape
        generator = torch.Generator().manual_seed(seed)
        self.turn = torch.rand(2, count, generator=generator).to(image)
        self.speed = torch.zeros(count, 5 + channels).to(image)

    def run(self, iterations: int, seconds: float = math.inf) -> Codes:
        """Round everything in so many iterations and seconds, and return the whole numbers."""
        start, share = time.perf_counter(), 0.0
        for iteration in range(iterations):
            share = max(share, iteration / iterations)
            if seconds < math.inf:
                share = max(share, (time.perf_counter() - start) / max(seconds, 1e-9))
            if share >= 1:
                break
            shaped = self.turn[0] < share / _SHAPES
            colored = self.turn[1] < (share - _SHAPES) / (1 - _SHAPES)
            self._step(shaped[:, None], colored[:, None])
        return self._codes()

    def _codes(self) -> Codes:
        """Return what the Gaussians round to now."""
        gaussians = Parameters(*(numbers.double().numpy() for numbers in self.free))
        return self.quantizer.quantize(gaussians, self.classes)

    def _step(self, shaped: Tensor, colored: Tensor) -> None:
        """Move what is free, against the render of what is rounded and what is not."""
        rounded = [torch.from_numpy(t).to(self.image) for t in self.quantizer.restore(self._codes())]
        fixed = (shaped, shaped, colored)
        current = [torch.where(fix, r, f) for fix, r, f in zip(fixed, rounded, self.free, strict=True)]
        downhill = self._downhill(*current)
        stopped = torch.cat([shaped.expand(-1, 5), colored.expand(-1, downhill.shape[1] - 5)], -1)
        self.speed = torch.where(stopped, 0.0, _MOMENTUM * self.speed + downhill)
        step = _STEP * self.speed
        means, cholesky = move(current[0], current[1], step[:, :5].clamp(-_LARGEST, _LARGEST), exact=False)
        moved = means, cholesky, current[2] + step[:, 5:]
        self.free = [torch.where(fix, f, m) for fix, f, m in zip(fixed, self.free, moved, strict=True)]

    def _downhill(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        """Return Newton's steps of each number alone: of centre and factor in the Gaussian's frame, of colours."""
        size = self.quantizer.size
        x, factors, c = (t.detach().requires_grad_() for t in (means, cholesky, colors))
        render = region_splat(x, factors, c, self.region_ids, self.regions, size=size, cutoff=_DRAFT_CUTOFF)
        difference = render.detach() - self.image
        if self.objective is not None:
            difference = self.objective.apply(difference)
        gradients = torch.autograd.grad(render, (x, factors, c), difference)
        area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(size[0] * size[1])
        energy = (colors.square().sum(-1) * area).clamp_min(_FAINT)
        curvature = torch.tensor(_CURVATURE).to(energy) * energy[:, None]
        shape = (local_gradient(cholesky, *gradients[:2]) / curvature).clamp(-_NEWTON, _NEWTON)
        return -torch.cat([shape, gradients[2] / area[:, None]], -1)
