"""A scene and its image in, a file out: Gaussians that do not pay for their bits go, the others are fine tuned."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs._image import as_image
from kcgs._repr import brief
from kcgs.codec import decode
from kcgs.codec.gaussians.quantize import Codes, Quantizer
from kcgs.codec.scenes import QUALITIES, SceneWriter
from kcgs.errors import InvalidArgument
from kcgs.fitting.config import Objective
from kcgs.fitting.objective import make_objective
from kcgs.functional import psnr
from kcgs.kernels import threads_for_kernels
from kcgs.scene import Scene

from .tuning import Tuning

# dB of a file's image against the scene's own above the scene's PSNR: the error grows by about a 28th, 0.15 dB,
# and by more where so few Gaussians are rounded that errors do not average out
_MARGIN = 14.5
# dB by which files are finer that are tried until one is good enough
_FINER = (0.0, 2.0, 5.0, 9.0, 14.0, 20.0, 30.0, 50.0)
# share of the iterations before anything is rounded, and how many go by between two looks at the distortion
_FREE, _LOOK = 0.7, 70
_DROP = 0.8
# of the bytes: what the descent goes by, for tuned files are smaller; what is aimed at in rounding, where Gaussians too
# many are left out; and what is near enough not to try again, up to so many times
_TUNED, _AIM, _NEAR, _TRIES = 1.006, 1.01, 0.995, 3
# many numbers are small, and take no more bits where all are finer: a step for more bytes is longer by this factor
_GAIN = 1.3


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
    objective: str = "psnr",
) -> Compressed:
    """Write a scene as a `.kcgs` file, rounded with an eye on the image that it shows.

    Gaussians descend on the squared error and, at the rate at which bits buy error, on their bits. Then they are
    rounded a few at a time, and those that are still free make up for it: about a third less error than
    :func:`kcgs.codec.encode` at the same bytes. Those too faint to pay for their bits are left out.

    Args:
        scene: N Gaussians of one image; opacities are merged into the colours, and notes are not kept.
        image: what :func:`kcgs.fit` takes, of the scene's size and channels.
        quality: as in :func:`kcgs.codec.encode`, before the others make up for it.
        target_bytes: the finest file that is not larger, in place of `quality`.
        target_psnr: dB against the image, in place of both: the first of ever finer files that shows it, or where the
            scene itself does not, one that is nearly as good.
        iterations: renders that the descent may take, at least 1.
        seed: of the order in which Gaussians are rounded.
        objective: of the descent, psnr or ms-ssim, as in :class:`kcgs.FitConfig`.

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
        raise InvalidArgument("image", f"shape {(writer.channels, *writer.size)}", tuple(target.shape), verb="have")
    # a copy: an inference tensor cannot take part in a graph
    target = target.detach().to("cpu", torch.float32, copy=True)
    if target_psnr is not None and (quality is not None or target_bytes is not None):
        raise InvalidArgument("target_psnr", "None with quality or target_bytes", target_psnr)
    qp = writer.qp_for(quality, target_bytes)
    check_count("iterations", iterations)
    if objective not in get_args(Objective):
        raise InvalidArgument("objective", f"one of {', '.join(get_args(Objective))}", repr(objective))
    press = _Press(writer, target, objective, iterations, seed)
    with threads_for_kernels(target[0].numel()):
        if target_bytes is not None:
            data = press.largest(target_bytes)
        elif target_psnr is None:
            data = press.write(qp)
        else:
            data = press.first_that_shows(check_number("target_psnr", target_psnr, 0.0, unit="dB"), scene)
    return Compressed(data, decode(data).scene)


class _Press:
    """Writes a scene with an eye on its image."""

    def __init__(self, writer: SceneWriter, image: Tensor, objective: str, iterations: int, seed: int) -> None:
        self.writer, self.image, self.objective = writer, image, make_objective(objective, image)
        self.seed, self.free = seed, int(_FREE * iterations)
        self.rounds = iterations - self.free

    def write(self, qp: int) -> bytes:
        """Return the file at a quantization parameter."""
        return self._round(self._spare(lambda _: qp), qp, self.rounds)

    def first_that_shows(self, decibels: float, scene: Scene) -> bytes:
        """Return the first of ever finer files that shows so much; where the scene does not, one nearly as good."""
        reached = float(psnr(scene.render().to(self.image), self.image))
        for finer in _FINER if reached >= decibels else _FINER[:1]:
            data = self.write(self.writer.qp_for(quality_for(reached + finer)))
            if float(psnr(decode(data).scene.render(), self.image)) >= decibels:
                break
        return data

    def largest(self, target_bytes: int) -> bytes:
        """Return a file that is hardly smaller."""
        qp = self.writer.qp_for(None)

        def follow(writer: SceneWriter) -> int:
            nonlocal qp
            size = len(writer.write_rounded(qp))
            qp = writer.next_qp(qp, size, size + round(_GAIN * (_TUNED * target_bytes - size)))
            return qp

        follow(self.writer)
        writer = self._spare(follow)
        qp, data = writer.finest(lambda qp: self._round(writer, qp, 0), target_bytes)
        best, plain, most = b"", data, self.writer.qp_for(QUALITIES[1])
        for _ in range(_TRIES):
            qp = min(writer.next_qp(qp, len(data), round(_AIM * target_bytes)), most)
            data = self._round(writer, qp, self.rounds, target_bytes)
            best = max(best, data if len(data) <= target_bytes else b"", key=len)
            if len(data) >= _NEAR * target_bytes or qp == most:
                break
        return best or plain

    def _spare(self, follow: Callable[[SceneWriter], int]) -> SceneWriter:
        """Descend with nothing rounded, at the quantization parameter that `follow` says now and then."""
        writer = self.writer
        tuning: Tuning | None = None
        for done in range(0, self.free, _LOOK):
            quantizer = Quantizer(follow(writer), writer.size)
            tuning = tuning or self._tuning(writer, quantizer)
            tuning.quantizer = quantizer
            if done >= _DROP * self.free:
                tuning.drop()
            tuning.descend(min(_LOOK, self.free - done))
            writer = writer.of(tuning.gaussians, tuning.ids)
        return writer

    def _round(self, writer: SceneWriter, qp: int, rounds: int, most: float = math.inf) -> bytes:
        tuning = self._tuning(writer, Quantizer(qp, writer.size))
        tuning.drop()
        data = b""

        def excess(codes: Codes) -> int:
            nonlocal data
            data = writer.write(tuning.quantizer, codes, tuning.ids)
            return max(0, math.ceil((len(data) - most) * len(tuning.ids) / len(data)))

        codes = tuning.round(rounds, self.seed, None if math.isinf(most) else excess)
        return data or writer.write(
            tuning.quantizer, codes, tuning.ids
        )  # the codes are those that `excess` was asked last

    def _tuning(self, writer: SceneWriter, quantizer: Quantizer) -> Tuning:
        return Tuning(writer.gaussians, writer.ids, self.image, writer.regions, quantizer, self.objective)


def quality_for(decibels: float) -> float:
    """Return the `quality` of a file that is nearly as good as its scene.

    Args:
        decibels: PSNR of the scene's render against the image.

    Example:
        >>> quality_for(30.0), quality_for(100.0)
        (44.5, 90.0)
    """
    return min(max(decibels + _MARGIN, QUALITIES[0]), QUALITIES[1])
