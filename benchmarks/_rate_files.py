"""The files that bench rate measures, of kcgs and of other codecs, made once and kept."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import statistics
import time
from collections.abc import Callable
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from kcgs._atomic import write_file
from kcgs.codec import decode
from kcgs.data import load_labels
from kcgs.evaluation import measure
from kcgs.fitting import FitConfig, warm_up
from kcgs.rate import compress, fit_bytes
from kcgs.scene import Scene, load

from ._codecs import CODECS, largest, lossless_bytes, open_file
from ._render_runs import pairs_per_pixel
from .core import eye, images
from .core.cases import BEST, QUICK_ITERATIONS, Case
from .core.store import Store, find_labels

MAPS = "maps"
# codecs of label maps
LABELS, LOSSLESS_WEBP = "kcgs.codec.labels", "WebP, lossless"
KCGS, NO_REGIONS, FLOAT = "kcgs", "kcgs, no regions", "float scene"
MS_SSIM = "kcgs, ms-ssim"
OBJECTIVES = {KCGS: "psnr", NO_REGIONS: "psnr", MS_SSIM: "ms-ssim"}
# of `compress`
ITERATIONS, QUICK_TUNING = inspect.signature(compress).parameters["iterations"].default, 10
# a fit's file is rounded until it costs so many dB; the dB above its PSNR at which that is tried first
MOST_LOSS, FIRST_QUALITY = 0.15, 14.5
QUICK_STRIDE = 2
CUTOFF = 1e-4  # of renders
_TRIES, _NEAR = 4, 0.02
Result = TypeVar("Result")


class Point(NamedTuple):
    """A file, or the scene before it is one."""

    group: str
    image: str
    codec: str
    asked: int  # bytes that it may have; in the group precision: how many Gaussians
    bytes: int
    bpp: float  # bits per pixel, everything included
    setting: str = ""
    psnr: float = math.nan
    ms_ssim: float = math.nan
    ef_psnr: float = math.nan
    ef_ssim: float = math.nan
    encode_seconds: float = math.nan  # of kcgs: the fit included
    decode_seconds: float = math.nan
    num_gaussians: int = 0
    regions: int = 0  # of the map in the file, 1: there is none
    ssimulacra2: float = math.nan  # measured afterwards, like butteraugli, where that can be
    butteraugli: float = math.nan
    pairs_per_pixel: float = 0.0  # of Gaussians and pixels, which decoding evaluates


class Ask(NamedTuple):
    """Which file: a point's first fields."""

    group: str
    image: str
    codec: str
    asked: int


class Files:
    """Makes files and keeps them, each beside its point, under a hash of all that it depends on.

    Where it makes none, only what is kept is there: a report of what was finished.
    """

    def __init__(self, folder: Path, data: Path | None, quick: bool, makes: bool = True) -> None:
        self.fits = Store(folder, data)
        self.folder, self.data, self.quick, self.makes = folder, data, quick, makes
        self.paths: dict[Ask, Path] = {}  # of what was asked for
        self.missed = 0  # how often something was not there that may not be made
        self.config = BEST.config(QUICK_ITERATIONS if quick else None)
        self.tuning = QUICK_TUNING if quick else ITERATIONS

    def other(self, group: str, image: str, codec: str, most: int) -> list[Point]:
        """Return the largest file of another codec of at most `most` bytes."""
        ask = Ask(group, image, codec, most)

        def make() -> tuple[Point, bytes]:
            coded = largest(codec, self.sample(image)[0].image, most, quick=self.quick)
            shown, seconds = timed(lambda: open_file(coded.data))
            point = self._measured(ask, shown, len(coded.data))
            point = point._replace(setting=coded.setting, encode_seconds=coded.seconds, decode_seconds=seconds)
            return point, coded.data

        return self.keep(ask, [*CODECS[codec]], make)

    def fitted(self, group: str, image: str, most: int, codec: str = KCGS) -> list[Point]:
        """Return kcgs' file of a fit to so many bytes."""
        ask, regions = Ask(group, image, codec, most), codec != NO_REGIONS
        config = self.config.model_copy(update={"objective": OBJECTIVES[codec]})
        settings = self.settings("fit_bytes", config)

        def make() -> tuple[Point, bytes]:
            sample, segment_seconds = self.sample(image)
            labels = sample.labels if regions else None
            start = time.perf_counter()
            made = fit_bytes(sample.image, labels, most, recipe=config)
            seconds = time.perf_counter() - start + (segment_seconds if regions else 0.0)
            made.result.scene.save(self.path(ask, settings, "safetensors"))
            return self._of_file(ask, made.data)._replace(encode_seconds=seconds), made.data

        return self.keep(ask, settings, make)

    def rewritten(self, fitted: Point, most: int) -> list[Point]:
        """Return the same fit's file of at most `most` bytes."""
        first = Ask(*fitted[:4])
        ask = first._replace(asked=most)

        def make() -> tuple[Point, bytes]:
            scene = load(self.path(first, self.settings("fit_bytes"), "safetensors"))
            image = self.sample(ask.image)[0].image
            start = time.perf_counter()
            data = compress(scene, image, target_bytes=most, iterations=self.tuning).data
            seconds = fitted.encode_seconds + time.perf_counter() - start
            return self._of_file(ask, data)._replace(encode_seconds=seconds), data

        return self.keep(ask, [*self.settings("rewritten"), fitted.asked], make)

    def case(self, image: str, n: int) -> Case:
        """Return the fit of so many Gaussians."""
        quick: dict[str, Any] = {"iterations": QUICK_ITERATIONS, "stride": QUICK_STRIDE} if self.quick else {}
        return Case(image, n, BEST, **quick)

    def scene(self, group: str, image: str, n: int) -> list[Point]:
        """Return the fit of so many Gaussians, as it is before it is a file."""
        case = self.case(image, n)
        if self.makes and self.fits.row(case) is None:
            self.fits.make(case)
        row = self.fits.row(case)
        if row is None:
            self.missed += 1
            return []
        figures = (row.psnr, row.ms_ssim, row.ef_psnr, row.ef_ssim)
        point = Point(group, image, FLOAT, n, 0, 0.0, "", *figures, encode_seconds=row.seconds)
        return [_with_counts(point, self.fits.scene(case))]

    def rounded(self, scene: Point) -> list[Point]:
        """Return the smallest file of a scene, of a few tries, that loses at most `MOST_LOSS` dB."""
        ask = Ask(scene.group, scene.image, KCGS, scene.asked)
        loaded = partial(self.fits.scene, self.case(scene.image, scene.asked))

        def make() -> tuple[Point, bytes]:
            image, best, quality = self.sample(ask.image)[0].image, None, scene.psnr + FIRST_QUALITY
            for _ in range(1 if self.quick else _TRIES):
                start = time.perf_counter()
                data = compress(loaded(), image, quality=quality, iterations=self.tuning).data
                seconds = time.perf_counter() - start
                point = self._of_file(ask, data)._replace(setting=f"quality {quality:.2f}", encode_seconds=seconds)
                loss = scene.psnr - point.psnr
                if loss <= MOST_LOSS and (best is None or len(data) < len(best[1])):
                    best = point, data
                if 0 <= MOST_LOSS - loss < _NEAR:
                    break
                quality += step(quality - scene.psnr, loss)
            return best or (point, data)

        return self.keep(ask, [*self.settings("compress"), MOST_LOSS, FIRST_QUALITY, _TRIES], make)

    def label_map(self, image: str) -> list[Point]:
        """Return the sizes of a label map alone; `image` is FOLDER/NAME."""
        from kcgs.codec.labels import encode_labels  # compiles loops

        def make(codec: str) -> tuple[Point, bytes]:
            folder, _, name = image.partition("/")
            if self.data is None or folder == image:
                labels = self.sample(image)[0].labels
                assert labels is not None
            else:
                is_davis = folder == "DAVIS"
                labels = images.davis(self.data)[name].labels if is_davis else load_labels(self.data / f"{image}.png")
            size, regions = lossless_bytes(labels), len(torch.unique(labels))
            size = len(encode_labels(labels.numpy())) if codec == LABELS else size
            return Point(MAPS, image, codec, 0, size, 8 * size / labels.numel(), regions=regions), b""

        asks = [Ask(MAPS, image, codec, 0) for codec in (LABELS, LOSSLESS_WEBP)]
        return [p for ask in asks for p in self.keep(ask, self.settings(MAPS), partial(make, ask.codec))]

    def keep(self, ask: Ask, settings: Any, make: Callable[[], tuple[Point, bytes]]) -> list[Point]:
        """Return a point that is kept, or is made and kept with its file; none where it is not there."""
        path = self.path(ask, settings, "json")
        if not path.is_file() and self.makes:
            if not self.quick:
                _warm_up(self.config)
            point, data = make()
            path.with_suffix(".file").write_bytes(data)
            write_file(path, json.dumps(point))
        if not path.is_file():
            self.missed += 1
            return []
        point, self.paths[ask] = Point(*json.loads(path.read_text(encoding="utf-8"))), path.with_suffix(".file")
        if self.makes and not math.isnan(point.psnr):
            seen = eye.look(point, lambda: (self.shown(point), self.sample(ask.image)[0].image))
            if seen is not point:
                write_file(path, json.dumps(seen))
            return [seen]
        return [point]

    def shown(self, point: Point) -> Tensor:
        """Decode a point's file."""
        data = self.paths[Ask(*point[:4])].read_bytes()
        return render(data) if point.codec in OBJECTIVES else open_file(data)

    def path(self, ask: Ask, settings: Any, suffix: str) -> Path:
        """Say where a file is, or would be."""
        fields = [name for name in Point._fields if name not in (*eye.MEASURES, "pairs_per_pixel")]
        parts = json.dumps([*ask, self.quick, settings, fields], sort_keys=True)
        name = "-".join(map(str, ask))
        name = "".join(c if c.isalnum() or c in "-." else "_" for c in name)
        return self.folder / f"{name}-{hashlib.sha256(parts.encode()).hexdigest()[:16]}.{suffix}"

    def settings(self, how: str, config: FitConfig | None = None) -> list[Any]:
        """Return what a file of kcgs depends on."""
        return [how, codec_digest(), (config or self.config).model_dump(mode="json")]

    def sample(self, image: str) -> tuple[images.Sample, float]:
        """Read an image, and how long finding its map took where it has none."""
        return _sample(image, self.data, QUICK_STRIDE if self.quick else 1)

    def _of_file(self, ask: Ask, data: bytes) -> Point:
        """Measure kcgs' own."""
        shown, seconds = timed(lambda: render(data))
        point = self._measured(ask, shown, len(data))
        scene = decode(data).scene
        pairs = pairs_per_pixel("cpu", scene, CUTOFF)
        return _with_counts(point._replace(decode_seconds=seconds, pairs_per_pixel=pairs), scene)

    def _measured(self, ask: Ask, shown: Tensor, size: int) -> Point:
        sample = self.sample(ask.image)[0]
        figures: dict[str, Any] = measure(shown, sample.image, sample.labels)
        del figures["ssim"]
        return Point(*ask, size, 8 * size / sample.image[0].numel(), **figures)


def render(data: bytes) -> Tensor:
    """Decode a file of kcgs to its image."""
    return decode(data).scene.render()


def timed(call: Callable[[], Result], repeats: int = 3) -> tuple[Result, float]:
    """Return what a call returns, and the median of its seconds after one call to warm up."""
    result, seconds = call(), []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


def step(above: float, loss: float) -> float:
    """Say by how much another quality, in dB, is to lose nearly `MOST_LOSS`; rounding's error adds to the fit's."""
    share = 10 ** (loss / 10) - 1
    if share <= 0:
        return -3.0
    wanted = 10 ** ((MOST_LOSS - _NEAR / 2) / 10) - 1
    return min(max(10 * math.log10(share / wanted), 2.0 - above, -3.0), 6.0)


@cache
def codec_digest(but: tuple[str, ...] = ()) -> str:
    """Hash the code that writes files, but that of some folders."""
    import kcgs

    root, digest = Path(kcgs.__file__).parent, hashlib.sha256()
    for path in sorted(path for folder in ("codec", "rate") for path in (root / folder).rglob("*.[pb][yi]*")):
        if not path.relative_to(root).as_posix().startswith(but):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _with_counts(point: Point, scene: Scene) -> Point:
    regions = 1 if scene.regions is None else scene.regions.num_regions
    return point._replace(num_gaussians=scene.num_gaussians, regions=regions)


@lru_cache(maxsize=2)
def _sample(name: str, data: Path | None, stride: int) -> tuple[images.Sample, float]:
    sample = images.load(name, data, stride)
    labels, seconds = find_labels("given" if sample.labels is not None else "auto", *sample)
    return sample._replace(labels=labels), seconds


@lru_cache(maxsize=8)
def _warm_up(config: FitConfig) -> None:
    """Compile what a file needs: no clock shall count it."""
    warm_up(config)
    ramp = torch.linspace(0.0, 1.0, 96).expand(3, 64, 96)
    short = config.model_copy(update={"iterations": min(config.usual_iterations, 20), "max_seconds": None})
    fit_bytes(ramp, (ramp[0] > 0.6).long().contiguous(), 300, recipe=short)
