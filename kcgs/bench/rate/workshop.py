"""Where files are made and measured, unless they are kept from an earlier call."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from kcgs.bench.measure import measure
from kcgs.codec import decode
from kcgs.fit import FitConfig, fit, warm_up
from kcgs.functional import RegionMap
from kcgs.io import load, save
from kcgs.nn import GaussianField
from kcgs.nn.renderer import render_image
from kcgs.rate import compress, fit_bytes

from .codecs import CODECS, largest, open_file
from .pictures import Picture, read
from .points import FLOAT, KCGS, NO_REGIONS, Ask, Point, Store, codec_digest

RECIPE = "best"
QUICK_ITERATIONS = 12
# of `compress`
ITERATIONS, QUICK_TUNING = 100, 10
# a fit's file rounded until it costs so many dB, and the dB above its PSNR at which that is tried first
MOST_LOSS, FIRST_QUALITY = 0.15, 14.5
_TRIES, _NEAR = 4, 0.02
_Result = TypeVar("_Result")


class Workshop:
    """Makes files and keeps them.

    Args:
        store: where they are kept.
        data: folder of the pictures.
        quick: the short form.
        makes: False: only what is kept is there, so that a report is of what was finished.
    """

    def __init__(self, store: Store, data: Path | None, quick: bool, makes: bool = True) -> None:
        self.store, self.data, self.quick, self.makes = store, data, quick, makes
        self.missed = 0  # how often something was not there that may not be made
        overrides = {"iterations": QUICK_ITERATIONS} if quick else {}
        self.config = FitConfig.from_recipe(RECIPE, **overrides)
        self.tuning = QUICK_TUNING if quick else ITERATIONS

    def other(self, group: str, image: str, codec: str, most: int, *, exact: bool = True) -> Point | None:
        """Return the largest file of another codec of at most `most` bytes; not `exact`: of about as many."""
        ask = Ask(group, image, codec, most, self.quick)
        known = CODECS[codec]
        settings = [known.qualities, known.settings, known.variants, dict(known.draft), exact]

        def make() -> Point:
            picture = read(group, image, self.data)
            coded = largest(codec, picture.image, most, exact=exact, quick=self.quick)
            shown, seconds = timed(lambda: open_file(coded.data))
            point = self._measured(ask, picture, shown, coded.data)
            point = point._replace(setting=coded.setting, encode_seconds=coded.seconds, decode_seconds=seconds)
            return self.store.write(ask, settings, point, coded.data)

        return self._kept(ask, settings, make)

    def fitted(self, group: str, image: str, most: int, *, regions: bool = True) -> Point | None:
        """Return kcgs' file of a fit to so many bytes."""
        ask = Ask(group, image, KCGS if regions else NO_REGIONS, most, self.quick)
        settings = self._settings("fit_bytes")

        def make() -> Point:
            picture = read(group, image, self.data)
            if not self.quick:
                _warm_up(self.config)
            labels = picture.labels if regions else None
            start = time.perf_counter()
            made = fit_bytes(picture.image, labels, most, config=self.config)
            seconds = time.perf_counter() - start + (picture.seconds if regions else 0.0)
            save(self.store.path(ask, settings, "safetensors"), made.result.field, made.result.regions)
            point = self._of_file(ask, picture, made.data)
            return self.store.write(ask, settings, point._replace(encode_seconds=seconds), made.data)

        return self._kept(ask, settings, make)

    def rewritten(self, fitted: Point, most: int) -> Point | None:
        """Return the same fit's file of at most `most` bytes, fewer than it was made for."""
        first = Ask(fitted.group, fitted.image, fitted.codec, fitted.asked, self.quick)
        ask = first._replace(asked=most)
        settings = [*self._settings("rewritten"), fitted.asked]

        def make() -> Point:
            picture = read(ask.group, ask.image, self.data)
            scene = load(self.store.path(first, self._settings("fit_bytes"), "safetensors"))
            start = time.perf_counter()
            data = compress(scene.field, picture.image, scene.regions, target_bytes=most, iterations=self.tuning)
            seconds = fitted.encode_seconds + time.perf_counter() - start
            point = self._of_file(ask, picture, data)
            return self.store.write(ask, settings, point._replace(encode_seconds=seconds), data)

        return self._kept(ask, settings, make)

    def scene(self, group: str, image: str, n: int) -> Point | None:
        """Return the fit of so many Gaussians, as it is before it is a file."""
        ask, settings = Ask(group, image, FLOAT, n, self.quick), [self.config.model_dump(mode="json")]

        def make() -> Point:
            picture = read(group, image, self.data)
            if not self.quick:
                warm_up(self.config)
            start = time.perf_counter()
            result = fit(picture.image, picture.labels, n, config=self.config)
            seconds = time.perf_counter() - start
            save(self.store.path(ask, settings, "safetensors"), result.field, result.regions)
            point = self._measured(ask, picture, render_image(result.field, result.regions), b"")
            return self.store.write(
                ask, settings, _with_counts(point, result.field, result.regions)._replace(encode_seconds=seconds)
            )

        return self._kept(ask, settings, make)

    def load_scene(self, scene: Point) -> tuple[GaussianField, RegionMap | None]:
        """Load what `scene` returned."""
        ask = Ask(scene.group, scene.image, FLOAT, scene.asked, self.quick)
        loaded = load(self.store.path(ask, [self.config.model_dump(mode="json")], "safetensors"))
        return loaded.field, loaded.regions

    def rounded(self, scene: Point) -> Point | None:
        """Return the smallest file of a scene, of a few tries, that loses at most `MOST_LOSS` dB."""
        ask = Ask(scene.group, scene.image, KCGS, scene.asked, self.quick)
        settings = [*self._settings("compress"), MOST_LOSS, FIRST_QUALITY, _TRIES]

        def make() -> Point:
            picture, best, quality = read(ask.group, ask.image, self.data), None, scene.psnr + FIRST_QUALITY
            for _ in range(1 if self.quick else _TRIES):
                point, data = self._compress(ask, picture, scene, quality)
                loss = scene.psnr - point.psnr
                if loss <= MOST_LOSS and (best is None or len(data) < len(best[1])):
                    best = point, data
                if 0 <= MOST_LOSS - loss < _NEAR:
                    break
                quality += _step(quality - scene.psnr, loss)
            point, data = best or (point, data)
            return self.store.write(ask, settings, point, data)

        return self._kept(ask, settings, make)

    def keep(self, ask: Ask, settings: Any, make: Callable[[], Point]) -> Point | None:
        """Return any other point of kcgs."""
        settings = [*self._settings("other"), settings]
        return self._kept(ask, settings, lambda: self.store.write(ask, settings, make()))

    def _compress(self, ask: Ask, picture: Picture, scene: Point, quality: float) -> tuple[Point, bytes]:
        field, regions = self.load_scene(scene)
        start = time.perf_counter()
        data = compress(field, picture.image, regions, quality=quality, iterations=self.tuning)
        seconds = time.perf_counter() - start
        point = self._of_file(ask, picture, data)
        return point._replace(setting=f"quality {quality:.2f}", encode_seconds=seconds), data

    def _settings(self, how: str) -> list[Any]:
        return [how, codec_digest(), self.config.model_dump(mode="json")]

    def _kept(self, ask: Ask, settings: Any, make: Callable[[], Point]) -> Point | None:
        found = self.store.read(ask, settings)
        if found is None and self.makes:
            return make()
        self.missed += found is None
        return found

    def _of_file(self, ask: Ask, picture: Picture, data: bytes) -> Point:
        """Measure kcgs' own."""
        decoded = decode(data)
        shown, seconds = timed(lambda: draw(data))
        point = self._measured(ask, picture, shown, data)._replace(decode_seconds=seconds)
        return _with_counts(point, decoded.field, decoded.regions)

    def _measured(self, ask: Ask, picture: Picture, shown: Tensor, data: bytes) -> Point:
        figures = measure(shown, picture.image, picture.labels)
        del figures["ssim"]
        pixels = picture.image.shape[-2] * picture.image.shape[-1]
        return Point(*ask[:4], len(data), 8 * len(data) / pixels, **figures)  # type: ignore[arg-type]


def draw(data: bytes) -> Tensor:
    """Decode a file of kcgs to its picture."""
    decoded = decode(data)
    return render_image(decoded.field, decoded.regions)


def timed(call: Callable[[], _Result], repeats: int = 3) -> tuple[_Result, float]:
    """Return what a call returns, and the median of its seconds after one call to warm up."""
    result, seconds = call(), []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


def _with_counts(point: Point, field: GaussianField, regions: RegionMap | None) -> Point:
    return point._replace(num_gaussians=len(field), regions=1 if regions is None else regions.num_regions)


def _step(above: float, loss: float) -> float:
    """Say by how much another quality, in dB, is to lose nearly `MOST_LOSS`; rounding's error adds to the fit's."""
    share = 10 ** (loss / 10) - 1
    if share <= 0:
        return -3.0
    wanted = 10 ** ((MOST_LOSS - _NEAR / 2) / 10) - 1
    return min(max(10 * math.log10(share / wanted), 2.0 - above, -3.0), 6.0)


@lru_cache(maxsize=8)
def _warm_up(config: FitConfig) -> None:
    """Compile what a file needs: no clock shall count it."""
    warm_up(config)
    ramp = torch.linspace(0.0, 1.0, 96).expand(3, 64, 96)
    short = config.model_copy(update={"iterations": min(config.iterations, 20), "max_seconds": None})
    fit_bytes(ramp, (ramp[0] > 0.6).long().contiguous(), 300, config=short)
