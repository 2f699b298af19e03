"""One picture fitted with the map of a source, or without: the scene is kept on disk as soon as it is done."""

from __future__ import annotations

import json
import math
import time
import warnings
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.bench.fit.cases import BASELINE, REFINED, Case, make_case
from kcgs.bench.sizes import write_scene
from kcgs.codec import Decoded, decode
from kcgs.codec.labels import encode_map
from kcgs.data import load_image
from kcgs.fit import fit, warm_up
from kcgs.functional import RegionMap, ef_psnr, psnr
from kcgs.io import Scene, load, save
from kcgs.nn.renderer import render_image
from kcgs.segment import segment

AUTO = "auto"
OTHERS = ("felzenszwalb", "slic", "watershed", "kmeans")
NO_MAP = "none"
FOLDER = "bsds"
COUNTS = (400, 1_000)
# the other sources are compared at the first of the counts, on every so many of the pictures
OTHERS_STRIDE = 4
QUICK_COUNT = 60
QUICK_STRIDE = 4
QUICK_IMAGES = 2


class Trial(NamedTuple):
    """One fit: of which picture, with how many Gaussians, with the map of which source (`NO_MAP`: the baseline)."""

    image: str
    n: int
    source: str
    quick: bool = False

    def case(self) -> Case:
        """Recipe and settings; those of a map are what `kcgs fit --regions auto` takes."""
        name = BASELINE if self.source == NO_MAP else REFINED
        case = make_case("maps", self.image, self.n, name, quick=self.quick)
        return case._replace(stride=QUICK_STRIDE if self.quick else 1)

    def baseline(self) -> Trial:
        """Return the fit of the same picture without a map."""
        return self._replace(source=NO_MAP)


class Result(NamedTuple):
    """A fit with a map beside the baseline of as many Gaussians, both measured in the band of the final map."""

    image: str
    n: int
    source: str
    given_regions: int
    regions: int  # in the end
    bytes: int  # of the scene's file
    map_bytes: int  # of these the final map's; 0: it has no contour
    psnr: float
    ef_psnr: float  # NaN: there is no contour
    baseline_psnr: float
    baseline_ef_psnr: float
    segment_seconds: float
    seconds: float  # of the fit
    baseline_seconds: float
    decoded_psnr: float = math.nan  # of the file
    decoded_ef_psnr: float = math.nan
    equal_n: int = 0  # of the baseline that the bytes of the file buy; 0: it was not asked for
    equal_bytes: int = 0  # of that baseline's file
    equal_psnr: float = math.nan  # decoded
    equal_ef_psnr: float = math.nan

    @property
    def gain(self) -> float:
        """Difference in PSNR, above zero where the map helps."""
        return self.psnr - self.baseline_psnr

    @property
    def ef_gain(self) -> float:
        """Difference in EF-PSNR."""
        return self.ef_psnr - self.baseline_ef_psnr

    @property
    def equal_gain(self) -> float:
        """Difference in PSNR to the baseline of as many bytes, both decoded."""
        return self.decoded_psnr - self.equal_psnr

    @property
    def equal_ef_gain(self) -> float:
        """Difference in EF-PSNR to the baseline of as many bytes, both decoded."""
        return self.decoded_ef_psnr - self.equal_ef_psnr


def images_of(data: Path | None) -> list[str]:
    """List the pictures; without data scikit-image's photo is all there is.

    Raises:
        ValueError: there are no pictures in the data.
    """
    if data is None:
        return ["astronaut"]
    found = sorted((p.parent.name for p in (data / FOLDER).glob("*/image.jpg")), key=lambda name: (len(name), name))
    if not found:
        raise ValueError(f"data must have a folder {FOLDER} with NAME/image.jpg in it; got {str(data)!r}")
    return found


def subset(images: list[str], quick: bool) -> list[str]:
    """Return the pictures that the other sources are compared on."""
    return images[:1] if quick else images[::OTHERS_STRIDE]


def plan(data: Path | None, quick: bool) -> list[Trial]:
    """List the fits with a map."""
    images = images_of(data)
    counts = (QUICK_COUNT,) if quick else COUNTS
    shown = images[:QUICK_IMAGES] if quick else images
    trials = [Trial(image, n, AUTO, quick) for n in counts for image in shown]
    return trials + [Trial(i, counts[0], source, quick) for i in subset(images, quick) for source in OTHERS]


class Scenes:
    """Finished fits in a folder, a scene each, named by picture, N, source and a hash of all settings."""

    def __init__(self, folder: Path, data: Path | None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._data = folder, data

    def has(self, trial: Trial) -> bool:
        """Say whether a fit is there."""
        return self._path(trial).is_file()

    def make(self, trial: Trial) -> None:
        """Fit, and keep the scene."""
        case, image = trial.case(), self._image(trial)
        warm_up(case.config())
        labels, segment_seconds = None, 0.0
        if trial.source != NO_MAP:
            _warm_up_source(trial.source)
            start = time.perf_counter()
            labels = segment(image, trial.source)
            segment_seconds = time.perf_counter() - start
        start = time.perf_counter()
        result = fit(image, labels, trial.n, config=case.config(), seed=case.seed)
        notes = {
            "settings": json.dumps(case.config().model_dump(mode="json")),
            "given_regions": 1 if labels is None else int(labels.max()) + 1,
            "segment_seconds": segment_seconds,
            "seconds": time.perf_counter() - start,
        }
        save(self._path(trial), result.field, result.regions, metadata={k: str(v) for k, v in notes.items()})

    def equal_bytes(self, trial: Trial) -> Trial | None:
        """Return the baseline with the Gaussians that the bytes of a finished fit buy; None: it is not asked for."""
        if trial.source != AUTO or not self.has(trial.baseline()):
            return None
        ours, other = (len(self._file(t)) for t in (trial, trial.baseline()))
        return trial.baseline()._replace(n=max(1, round(trial.n * ours / other)))

    def result(self, trial: Trial) -> Result | None:
        """Measure a fit beside its baselines; None: the fit, or the one of as many Gaussians, is not there."""
        if not (self.has(trial) and self.has(trial.baseline())):
            return None
        ours, other = load(self._path(trial)), load(self._path(trial.baseline()))
        image, regions, file = self._image(trial), _contours(ours), self._file(trial)
        labels = None if regions is None else regions.labels
        result = Result(
            trial.image,
            trial.n,
            trial.source,
            int(ours.metadata["given_regions"]),
            1 if regions is None else regions.num_regions,
            len(file),
            0 if regions is None else len(encode_map(regions)),
            *_quality(ours, image, labels),
            *_quality(other, image, labels),
            float(ours.metadata["segment_seconds"]),
            float(ours.metadata["seconds"]),
            float(other.metadata["seconds"]),
            *_quality(decode(file), image, labels),
        )
        rival = self.equal_bytes(trial)
        if rival is None or not self.has(rival):
            return result
        file = self._file(rival)
        psnr, ef_psnr = _quality(decode(file), image, labels)
        return result._replace(equal_n=rival.n, equal_bytes=len(file), equal_psnr=psnr, equal_ef_psnr=ef_psnr)

    def _file(self, trial: Trial) -> bytes:
        scene = load(self._path(trial))
        return write_scene(scene.field, scene.regions, _quality(scene, self._image(trial), None)[0])

    def _path(self, trial: Trial) -> Path:
        key = trial.case().key(trial.source)
        return self._folder / f"{trial.image}-{trial.n}-{trial.source}-{key}.safetensors"

    def _image(self, trial: Trial) -> Tensor:
        image = _read(self._data, trial.image)
        stride = trial.case().stride
        return image[:, ::stride, ::stride].contiguous()


def _contours(scene: Scene) -> RegionMap | None:
    """Return the map of a scene, None where it has no contour."""
    return scene.regions if scene.regions is not None and scene.regions.num_regions > 1 else None


def _quality(scene: Scene | Decoded, image: Tensor, labels: Tensor | None) -> tuple[float, float]:
    picture = render_image(scene.field, scene.regions)
    edges = math.nan if labels is None else float(ef_psnr(picture, image, labels))
    return float(psnr(picture, image)), edges


@lru_cache(maxsize=2)
def _read(data: Path | None, image: str) -> Tensor:
    if data is not None:
        return load_image(data / FOLDER / image / "image.jpg")
    from skimage import data as photos

    return torch.from_numpy(photos.astronaut()).permute(2, 0, 1).float() / 255


@lru_cache
def _warm_up_source(source: str) -> None:
    """Import what a source needs: no clock shall count it."""
    ramp = torch.linspace(0.0, 1.0, 64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        segment(torch.where(ramp > 0.4, 0.2 * ramp, 0.5 + 0.5 * ramp).expand(3, 48, 64), source)
