"""How small are label maps as files, beside other lossless codecs?"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from kcgs.codec import decode_labels, encode_labels
from kcgs.data import load_labels
from kcgs.segment import segment

from .core.compare import Comparison, count_wins, losses_table
from .core.figures import Panel, save_lines
from .core.images import load
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, means_table, values_of

# paths of the maps in the data; none of Kodak, because the tables of kcgs were trained on maps of Kodak
SETS = {
    "DAVIS 2016": "DAVIS/Annotations/480p/*/00000.png",
    "BSDS500": "bsds/*/mask.png",
    "BSDS500, finest": "bsds/*/mask_fine.png",
    "COCO-Stuff": "cocostuff/*/mask.png",
}
ROUNDS = 3
METHOD = """Bytes are those of whole files. Other codecs get regions by number: ids cost them nothing. PNG is the
smaller of grey and a palette, optimized; WebP is exact, with quality 100 and method 6; JPEG XL has effort 9; RLE is
COCO's strings, one per region but the first; crackle has a Markov model of order 5. A codec whose package is missing
(`pip install "kcgs[bench]"`) is left out. Speeds are medians of the time of one core, in millions of pixels per
second."""


class Codec(NamedTuple):
    """A codec's package, and its functions from region numbers (H, W) to bytes and back."""

    package: str
    encode: Callable[[Any], Any]
    decode: Callable[[Any], Any]


def _write(format: str, index: Any, **settings: Any) -> bytes:
    file, largest_id = BytesIO(), int(index.max())
    if format == "WEBP":
        image = Image.fromarray(np.stack([index >> 16, index >> 8, index], -1).astype(np.uint8))
    else:
        image = Image.fromarray(index.astype(np.uint8 if largest_id < 256 else np.uint16))
    image.save(file, format, **settings)
    return file.getvalue()


def _png(index: Any) -> bytes:
    grey, largest_id = _write("PNG", index, optimize=True), int(index.max())
    if largest_id > 255:
        return grey
    file, image = BytesIO(), Image.fromarray(index.astype(np.uint8))
    image.putpalette(list(range(largest_id + 1)) * 3)
    image.save(file, "PNG", optimize=True, bits=next(bits for bits in (1, 2, 4, 8) if largest_id < 1 << bits))
    return min(grey, file.getvalue(), key=len)


def _read(data: bytes) -> Any:
    with Image.open(BytesIO(data)) as image:
        values = np.asarray(image).astype(np.int32)
    return values if values.ndim == 2 else values @ np.array([1 << 16, 1 << 8, 1])


def _jxl(index: Any) -> bytes:
    plugin: Any = import_module("pillow_jxl.JpegXLImagePlugin")  # the import adds the format to Pillow
    plugin.DECODE_THREADS = 1
    return _write("JXL", index, lossless=True, effort=9, num_threads=1)


def _rle(index: Any) -> Any:
    masks = np.asfortranarray(index[..., None] == np.arange(1, max(2, index.max() + 1)), np.uint8)
    return import_module("pycocotools.mask").encode(masks)


def _crackle(index: Any) -> Any:
    small = index.astype(np.min_scalar_type(int(index.max())))
    return import_module("crackle").compress(small, markov_model_order=5, parallel=1)


encode_webp = partial(_write, "WEBP", lossless=True, quality=100, method=6, exact=True)
CODECS = {
    "kcgs": Codec("kcgs", encode_labels, decode_labels),
    "PNG": Codec("PIL", _png, _read),
    "WebP": Codec("PIL", encode_webp, _read),
    "JPEG XL": Codec("pillow_jxl", _jxl, _read),
    "RLE": Codec("pycocotools", _rle, lambda f: import_module("pycocotools.mask").decode(f) @ np.arange(1, len(f) + 1)),
    "crackle": Codec("crackle", _crackle, lambda data: import_module("crackle").decompress(data, parallel=1)),
}


def region_numbers(labels: Any) -> Any:
    """Number the regions of (H, W) in the order of their ids."""
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.int32)


def measure(image: str, group: str, data: str, quick: bool) -> list[Row]:
    """Code a map with all installed codecs; raise a RuntimeError if a codec changes a label."""
    labels = (load_labels(Path(data, image)) if data else segment(load(image, quick=quick).image)).numpy()
    index, rows = region_numbers(labels), []
    for name, codec in CODECS.items():
        if find_spec(codec.package) is None:
            continue
        values, seconds = labels if name == "kcgs" else index, []
        for _ in range(ROUNDS):
            start = time.process_time()
            file = codec.encode(values)
            middle = time.process_time()
            decoded = codec.decode(file)
            seconds.append((middle - start, time.process_time() - middle))
        if not (np.asarray(decoded).reshape(labels.shape) == values).all():
            raise RuntimeError(f"{name} loses labels of {image}")
        size = len(file) if isinstance(file, bytes) else sum(len(rle["counts"]) for rle in file)
        speeds = [1e-6 * labels.size / max(median(times), 1e-6) for times in zip(*seconds, strict=True)]
        row = {"image": image, "group": group, "method": name, "regions": int(index.max()) + 1, "bytes": size}
        rows.append({**row, "encode_speed": speeds[0], "decode_speed": speeds[1]})
    return rows


def jobs(options: Options) -> list[Job]:
    """List the maps of all sets; without data, the map that `segment` finds in a photo."""
    images = [("scikit-image, found", "astronaut")]
    if options.data is not None:
        images = [
            (group, str(path.relative_to(options.data)))
            for group, pattern in SETS.items()
            for path in sorted(options.data.glob(pattern))[: 1 if options.quick else None]
        ]
    return [{"image": image, "group": group, **options.image_arguments()} for group, image in images]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    sizes = {row["image"]: row["bytes"] for row in rows if row["method"] == "WebP"}
    for row in rows:
        row["bytes to WebP, %"] = 100 * row["bytes"] / sizes[row["image"]]
    comparisons = [Comparison("kcgs", name) for name in CODECS if name != "kcgs"]
    groups = {str(group): group_rows for (group,), group_rows in group_by(rows, ["group"]).items()}
    panels = [Panel(group, group_rows, "decode_speed", "bytes to WebP, %") for group, group_rows in groups.items()]
    save_lines(folder / "labels.png", panels, "method", "group")
    sums = {str(name): sum(values_of(group, "bytes")) for (name,), group in group_by(rows, ["method"]).items()}
    closest = min(sums.keys() - {"kcgs"}, key=sums.__getitem__)
    wins = count_wins(rows, Comparison("kcgs", closest), "bytes", ["group"])
    speeds = {
        str(name): fmean(values_of(group, "decode_speed")) for (name,), group in group_by(rows, ["method"]).items()
    }
    others = [speed for name, speed in speeds.items() if name != "kcgs"]
    answer = (
        f"All maps together take {100 * sums['kcgs'] / sums[closest]:.0f} % of the bytes of {closest}, the smallest of "
        f"the others, and {wins} maps are smaller. kcgs decodes {speeds['kcgs']:.0f} million pixels per second, the "
        f"others {min(others):.0f} to {max(others):.0f}."
    )
    table = means_table(rows, ["group", "method"], "", ("bytes", "bytes to WebP, %", "encode_speed", "decode_speed"))
    losses = losses_table(rows, comparisons, ["bytes", "decode_speed"], ["group"])
    return Page(answer, "labels.png", table, losses, METHOD)
