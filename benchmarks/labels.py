"""Label maps as files, beside other lossless codecs: `python -m benchmarks labels`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, features
from torch import Tensor

from kcgs.codec import decode_labels, encode_labels
from kcgs.data import load_labels
from kcgs.segment import segment

from .core.clocks import clock, in_turns
from .core.images import photo
from .core.jobs import with_progress
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows
from .core.tables import markdown, number

KCGS, WEBP = "kcgs", "WebP"
# where maps are in the data; none of Kodak, on whose maps the tables of kcgs were trained
SETS: dict[str, tuple[str, Callable[[Path], Tensor]]] = {
    "DAVIS 2016": ("DAVIS/Annotations/480p/*/00000.png", load_labels),
    "BSDS500": ("bsds/*/mask.png", load_labels),
    "BSDS500, finest": ("bsds/*/mask_fine.png", load_labels),
    "COCO-Stuff": ("cocostuff/*/mask.png", load_labels),
}
_INTRODUCTION = """Bytes: means of whole files. `to WebP`: the sum of a set's bytes over WebP's. Speeds: medians, of one
core's time, all codecs in turns. Other codecs get regions by number: ids cost them nothing. PNG: optimised, the smaller
of grey and a palette of as many colours as regions. WebP: exact, quality 100, method 6. JPEG XL: effort 9. RLE: COCO's
strings, one per region but the first. crackle: Markov model of order 5."""


class Codec(NamedTuple):
    """A codec: the package that it needs, and how an array (H, W) of regions' numbers becomes bytes, and back."""

    package: str
    encode: Callable[[Any], Any]
    decode: Callable[[Any], Any]


class Result(NamedTuple):
    """One map in one codec."""

    set: str
    map: str
    pixels: int
    regions: int
    codec: str
    bytes: int
    encode_seconds: float
    decode_seconds: float


def _write(format: str, index: Any, **settings: Any) -> bytes:
    file, most = BytesIO(), int(index.max())
    if format == "WEBP":
        image = Image.fromarray(np.stack([index >> 16, index >> 8, index], -1).astype(np.uint8))
    else:
        image = Image.fromarray(index.astype(np.uint8 if most < 256 else np.uint16))
    image.save(file, format, **settings)
    return file.getvalue()


def _png(index: Any) -> bytes:
    """Take the smaller of a palette of as many colours as there are regions, in few bits, and grey."""
    grey, most = _write("PNG", index, optimize=True), int(index.max())
    if most > 255:
        return grey
    file, image = BytesIO(), Image.fromarray(index.astype(np.uint8))
    image.putpalette(list(range(most + 1)) * 3)
    image.save(file, "PNG", optimize=True, bits=next(bits for bits in (1, 2, 4, 8) if most < 1 << bits))
    return min(grey, file.getvalue(), key=len)


def _read(data: bytes) -> Any:
    with Image.open(BytesIO(data)) as image:
        values = np.asarray(image).astype(np.int32)
    return values if values.ndim == 2 else values @ np.array([1 << 16, 1 << 8, 1])


def _jxl(index: Any) -> bytes:
    plugin: Any = import_module("pillow_jxl.JpegXLImagePlugin")  # adds the format to Pillow
    plugin.DECODE_THREADS = 1
    return _write("JXL", index, lossless=True, effort=9, num_threads=1)


def _rle(index: Any) -> Any:
    """Encode all regions but the first, which is what they leave."""
    masks = np.asfortranarray(index[..., None] == np.arange(1, max(2, index.max() + 1)), np.uint8)
    return import_module("pycocotools.mask").encode(masks)


def _crackle(index: Any) -> Any:
    small = index.astype(np.min_scalar_type(int(index.max())))
    return import_module("crackle").compress(small, markov_model_order=5, parallel=1)


CODECS = {
    KCGS: Codec("kcgs", encode_labels, decode_labels),
    "PNG": Codec("PIL", _png, _read),
    WEBP: Codec("PIL", partial(_write, "WEBP", lossless=True, quality=100, method=6, exact=True), _read),
    "JPEG XL": Codec("pillow_jxl", _jxl, _read),
    "RLE": Codec("pycocotools", _rle, lambda f: import_module("pycocotools.mask").decode(f) @ np.arange(1, len(f) + 1)),
    "crackle": Codec("crackle", _crackle, lambda data: import_module("crackle").decompress(data, parallel=1)),
}


def _is_there(codec: str) -> bool:
    return find_spec(CODECS[codec].package) is not None


def maps(data: Path | None, quick: bool) -> Iterator[tuple[str, str, Callable[[], Tensor]]]:
    """List the label maps: set, name, and what reads them; without data one is found in scikit-image's photo."""
    if data is None:
        yield "scikit-image, found", "astronaut", lambda: segment(photo("astronaut"))
        return
    for name, (pattern, read) in SETS.items():
        for path in sorted(data.glob(pattern))[: 1 if quick else None]:
            yield name, str(path.relative_to(data)), partial(read, path)


def measure(name: str, which: str, read: Callable[[], Tensor], rounds: int) -> list[Result]:
    """Code a map in all codecs that are there, in turns; what does not come back is a RuntimeError."""
    labels = read().numpy()
    ids, index = np.unique(labels, return_inverse=True)
    index = index.reshape(labels.shape).astype(np.int32)
    given = {c: labels if c == KCGS else index for c in CODECS if _is_there(c)}
    files = {c: CODECS[c].encode(values) for c, values in given.items()}
    for c, file in files.items():
        if not (np.asarray(CODECS[c].decode(file)).reshape(index.shape) == given[c]).all():
            raise RuntimeError(f"{c} loses labels of {name} {which}")
    actions = {(c, "encode"): partial(clock, partial(CODECS[c].encode, given[c]), process_time) for c in given}
    actions |= {(c, "decode"): partial(clock, partial(CODECS[c].decode, files[c]), process_time) for c in given}
    seconds = {key: median(times) for key, times in in_turns(actions, rounds).items()}
    sizes = {c: len(f) if isinstance(f, bytes) else sum(len(rle["counts"]) for rle in f) for c, f in files.items()}
    about = name, which, index.size, len(ids)
    return [Result(*about, c, sizes[c], seconds[c, "encode"], seconds[c, "decode"]) for c in given]


def report(output: Path, made: Made) -> list[str]:
    """Write the table of all sets."""
    results, lines = read_rows(output / "results.csv", Result), []
    for name in dict.fromkeys(r.set for r in results):
        webp = sum(r.bytes for r in results if (r.set, r.codec) == (name, WEBP))
        for codec in dict.fromkeys(r.codec for r in results):
            found = [r for r in results if (r.set, r.codec) == (name, codec)]
            total, ways = sum(r.bytes for r in found), ("encode_seconds", "decode_seconds")
            speeds = [number(median(1e-6 * r.pixels / getattr(r, way) for r in found)) for way in ways]
            share = f"{100 * total / webp:.1f} %"
            lines.append([name, str(len(found)), codec, number(total / len(found)), share, *speeds])
    header = ["set", "maps", "codec", "bytes", "to WebP", "MP/s, encode", "MP/s, decode"]
    return ["# Label maps, without loss", _INTRODUCTION, markdown(header, lines)]


@experiment(report=report)
def run(output: Path, options: Options) -> None:
    """Code all maps; a codec whose package is missing is left out, and the report says so."""
    wanted = list(maps(options.data, options.quick))
    if not wanted:
        raise ValueError(f"data must have maps such as {SETS['DAVIS 2016'][0]}; got {str(options.data)!r}")
    rounds = 1 if options.quick else 3
    steps = [(f"{name} {which}", partial(measure, name, which, read, rounds)) for name, which, read in wanted]
    write_rows(output / "results.csv", Result, [row for step in with_progress(steps) for row in step()])
    notes = [f"{c} is left out: its package {CODECS[c].package} is missing" for c in CODECS if not _is_there(c)]
    here = {CODECS[c].package for c in CODECS if c != KCGS and _is_there(c)}
    names = sorted({name for package in here for name in packages_distributions().get(package, ())})
    notes.append(", ".join([f"libwebp {features.version('webp')}", *(f"{name} {version(name)}" for name in names)]))
    notes += [f"{name} is not in the data" for name in SETS if options.data and name not in {w[0] for w in wanted}]
    conclude(report, output, Made(options.command("labels"), options.quick, (), tuple(notes)))
