"""Compress a scene, given its image: rate-distortion descent of the Gaussians, then gradual rounding."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from kcgs._check import check_count, check_number
from kcgs._image import as_image
from kcgs._objectives import check_objective, objective_for
from kcgs._repr import brief
from kcgs.codec import QPS, QUALITIES, Parameters, Quantizer, SceneWriter, decode
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.functional import psnr
from kcgs.optim import OBJECTIVES, End, ImageObjective, TimedAction, count_iterations, run
from kcgs.scene import Scene

from .rate_distortion import RATE, RateDistortionDescent
from .rounding import round_gradually

# dB between the scene's PSNR and `quality`: rounding then adds about a 28th to the squared error, 0.15 dB, or more if
# there are too few Gaussians for rounding errors to average out
_QUALITY_MARGIN = 14.5
# dB that are added to the quality until a file reaches `target_psnr`
_QUALITY_STEPS = (0.0, 2.0, 5.0, 9.0, 14.0, 20.0, 30.0, 50.0)

# These numbers are tuned: change one and compare the files of `python -m benchmarks rate`, which have the same size.

# share of the iterations before rounding starts; in the others the descent goes on while Gaussians are rounded. More:
# Gaussians are cheaper, and their neighbours correct less of the rounding errors
_DESCENT_SHARE = 0.7
# iterations between two updates of the QP, each of which writes a file. More: faster, and farther from the target
_UPDATE_INTERVAL = 70
# share of the descent after which Gaussians are pruned that save less error than their bits cost. More: they have more
# time to become useful, and the others have less time to replace them
_PRUNE_FROM = 0.8
# size that the descent aims at, as a share of `target_bytes`: gradual rounding saves 0.6 %
_DESCENT_AIM = 1.006
# size that rounding aims at, as a share of `target_bytes`; excess Gaussians are removed on the way. More: more
# Gaussians are removed. Less: more files are too small and are rounded again
_ROUNDING_AIM = 1.01
# share of `target_bytes` that is large enough. More: slower, and less error
_MIN_FILL = 0.995
# largest number of roundings of a scene until a file has `_MIN_FILL`
_MAX_ROUNDINGS = 3
# largest number of files that are written to find the QP of the first rounding
_MAX_SECANTS = 4
# factor on the change of size that an update of the QP aims at: numbers that round to 0 take no more bits when their
# steps become finer. More: the size oscillates. Less: it lags behind
_BYTES_GAIN = 1.3


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
    iterations: int = 600,
    seed: int = 0,
    objective: str | None = None,
    min_sigma: float = 0.0,
) -> Compressed:
    """Write a scene as a `.kcgs` file with the least error against its image.

    Convention: first a descent lowers the error plus the price of all bits. Then a few Gaussians at a time are rounded,
    while the Gaussians that are not rounded yet correct the error. Gaussians that save less error than their bits cost
    are removed. The error is about a third less than that of :func:`kcgs.codec.encode` at the same size.

    Args:
        scene: N Gaussians of one image; opacities are merged into the colours, and metadata are not stored.
        image: as in :func:`kcgs.fit`, with the scene's size and channels.
        quality: as in :func:`kcgs.codec.encode`; the error is lower, since Gaussians correct each other. None, without
            a target: the value of :func:`quality_for`, so that the file is nearly as good as the scene.
        target_bytes: write the best file of at most this size, in place of `quality`.
        target_psnr: PSNR in dB against the image, in place of both: write the coarsest of a few qualities that reaches
            it, none coarser than the default of `quality`. If the scene itself does not reach it, the file is nearly
            as good as the scene.
        iterations: renders that descent and rounding may take, at least 1.
        seed: of the order in which Gaussians are rounded, at least 0.
        objective: of the descent, l2 or ms-ssim, as in :class:`kcgs.FitConfig`. None: ms-ssim with `target_bytes`,
            else l2.
        min_sigma: least standard deviation of a Gaussian in pixels, before it is rounded.

    Returns:
        The file, and the scene that it decodes to.

    Raises:
        TypeError, ValueError: as :func:`kcgs.codec.encode`; an image that does not fit the scene; a number out of
            range, another `objective`. All come before the descent.

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
        raise InvalidArgument("image", f"shape {(writer.channels, *writer.size)}", tuple(target.shape), verb="have")
    # copy: autograd does not accept inference tensors
    target = target.detach().to("cpu", torch.float32, copy=True)
    if target_psnr is not None:
        check_number("target_psnr", target_psnr, 0.0, unit="dB")
        if quality is not None or target_bytes is not None:
            raise InvalidArgument("target_psnr", "None with quality or target_bytes", target_psnr)
    qp = writer.qp_for(quality, target_bytes)
    if target_bytes is not None:
        _check_target_bytes(writer, target_bytes)
    check_count("iterations", iterations)
    check_count("seed", seed, 0, 2**63 - 1)
    check_number("min_sigma", min_sigma, 0.0, unit="pixels")
    name = objective_for("file of a PSNR" if target_bytes is None else "file of a size", check_objective(objective))
    compressor = Compressor(writer, OBJECTIVES[name](target), iterations, seed, min_sigma)
    with threads_for_kernels(target[0].numel()):
        if target_bytes is not None:
            data = compressor.search_bytes(target_bytes)
        elif quality is not None:
            data = compressor.write(qp)
        else:
            scene_psnr = float(psnr(scene.render().to(target), target))
            if target_psnr is None:
                data = compressor.write(writer.qp_for(quality_for(scene_psnr)))
            else:
                data = compressor.search_psnr(target_psnr, scene_psnr)
    return Compressed(data, decode(data).scene)


def _check_target_bytes(writer: SceneWriter, target_bytes: int) -> None:
    """Refuse a size that the map and a single, coarse Gaussian exceed."""
    gaussian = Parameters(*(numbers[:1] for numbers in writer.gaussians))
    least = len(writer.with_gaussians(gaussian, writer.ids[:1]).write_rounded(QPS[0]))
    if check_count("target_bytes", target_bytes) < least:
        raise InvalidArgument("target_bytes", f"at least {least} for this scene", target_bytes)


def quality_for(psnr: float) -> float:
    """Return the `quality` of a file that is nearly as good as its scene.

    Args:
        psnr: of the scene's render against the image, in dB.

    Example:
        >>> quality_for(30.0), quality_for(100.0)
        (44.5, 90.0)
    """
    return min(max(psnr + _QUALITY_MARGIN, QUALITIES[0]), QUALITIES[1])


@dataclass(frozen=True)
class Compressor:
    """Rate-distortion descent and gradual rounding of one scene, at any quantization parameter (QP)."""

    writer: SceneWriter
    objective: ImageObjective  # of an image of the scene's size, or smaller
    iterations: int
    seed: int
    min_sigma: float

    @property
    def descent_iterations(self) -> int:
        """Number of iterations before rounding."""
        return int(_DESCENT_SHARE * self.iterations)

    @property
    def rounding_iterations(self) -> int:
        """Number of iterations in which Gaussians are rounded."""
        return self.iterations - self.descent_iterations

    def search_bytes(self, target_bytes: int) -> bytes:
        """Return a file of nearly, but at most, `target_bytes`."""

        def update_qp(writer: SceneWriter, qp: int) -> int:
            size = len(writer.write_rounded(qp))
            change = _DESCENT_AIM * target_bytes - size
            return writer.next_qp(qp, size, size + round(_BYTES_GAIN * change))

        writer, qp = self._descend(update_qp(self.writer, self.writer.qp_for(None)), update_qp)
        qp, max_qp = self._secant(writer, qp, target_bytes), self.writer.qp_for(QUALITIES[1])
        size, candidates = target_bytes, []
        for _ in range(_MAX_ROUNDINGS):
            qp = min(writer.next_qp(qp, size, round(_ROUNDING_AIM * target_bytes)), max_qp)
            data = self._write_gradually(writer, qp, self.rounding_iterations, target_bytes)
            size = len(data)
            if size <= target_bytes:
                candidates.append(data)
            if size >= _MIN_FILL * target_bytes or qp == max_qp:
                break
        if candidates:
            return max(candidates, key=len)
        return writer.largest_file(lambda qp: self._write_gradually(writer, qp, 0), target_bytes)[1]

    def _secant(self, writer: SceneWriter, qp: int, target_bytes: int) -> int:
        """Find, by the secant method, the QP at which a file has about `target_bytes` if it is rounded at once."""
        sizes: dict[int, int] = {}
        while len(sizes) < _MAX_SECANTS and qp not in sizes:
            sizes[qp] = len(self._write_gradually(writer, qp, 0))
            next_qp = writer.next_qp(qp, sizes[qp], target_bytes)
            if len(sizes) > 1:
                (a, size_a), (b, size_b) = [*sizes.items()][-2:]
                next_qp = b + round((target_bytes - size_b) * (b - a) / ((size_b - size_a) or math.inf))
            qp = min(max(next_qp, QPS[0]), QPS[1])
        return qp

    def search_psnr(self, target_psnr: float, scene_psnr: float) -> bytes:
        """Return the coarsest file that reaches `target_psnr`; if the scene does not reach it, the coarsest of all."""
        steps = _QUALITY_STEPS if scene_psnr >= target_psnr else _QUALITY_STEPS[:1]
        for quality in dict.fromkeys(quality_for(scene_psnr + step) for step in steps):
            data = self.write(self.writer.qp_for(quality))
            if float(psnr(decode(data).scene.render(), self.objective.image)) >= target_psnr:
                break
        return data

    def write(self, qp: int) -> bytes:
        """Return the file at a QP."""
        return self._write_gradually(self._descend(qp)[0], qp, self.rounding_iterations)

    def _descend(self, qp: int, update_qp: Callable[[SceneWriter, int], int] | None = None) -> tuple[SceneWriter, int]:
        """Lower error and bits before rounding; `update_qp` returns the QP for the current scene, None keeps it.

        Returns:
            The Gaussians, and the last QP.
        """
        writer, iterations = self.writer, self.descent_iterations
        descent = self._new_descent(writer)

        def update() -> None:
            nonlocal writer, qp
            if descent.iteration:
                writer = writer.with_gaussians(descent.parameters(), descent.ids)
            if update_qp is not None:
                qp = update_qp(writer, qp)
            descent.quantizer = Quantizer(qp, writer.size)
            if descent.iteration >= _PRUNE_FROM * iterations:
                descent.prune()

        progress = count_iterations(descent, iterations)
        times = [k / iterations for k in range(0, iterations, _UPDATE_INTERVAL)]
        run(descent, descent.step, progress, [End(), TimedAction(times, update)], lambda progress: RATE)
        return writer.with_gaussians(descent.parameters(), descent.ids) if iterations else writer, qp

    def _write_gradually(self, writer: SceneWriter, qp: int, iterations: int, max_bytes: float = math.inf) -> bytes:
        descent = self._new_descent(writer)
        descent.quantizer = quantizer = Quantizer(qp, writer.size)
        descent.prune()
        return round_gradually(
            descent, lambda codes: writer.write(quantizer, codes, descent.ids), iterations, self.seed, max_bytes
        )

    def _new_descent(self, writer: SceneWriter) -> RateDistortionDescent:
        return RateDistortionDescent(writer, self.objective, self.min_sigma)
