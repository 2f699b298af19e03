# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy>=1.26", "onnxruntime>=1.20"]
# ///
"""Decode kcgs scenes with numpy and onnxruntime alone.

    python decode.py decoder.onnx -o image.png --scale 4
    python decode.py generic.onnx scene.safetensors -o image.png

The first kind of decoder holds a scene, the second renders any scene of hard contours.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import statistics
import struct
import sys
import time
import uuid
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

try:
    import numpy as np
    import onnxruntime
except ImportError as missing:
    raise SystemExit(f"decode.py: {missing}; install what it needs: pip install numpy onnxruntime") from None

MAX_SIDE = 1 << 20
_PIXEL_BYTES = 36  # three numbers, three times: as rendered, clipped, and in levels
_FORMAT, _VERSION = "kcgs.decoder", "1"
_PARTS = 1 << 20
_SCENE_FORMAT, _SCENE_VERSIONS = "kcgs.scene", ("1", "2", "3")
_FLOAT, _INTEGER = "tensor(float)", "tensor(int64)"
_OPTIONAL = {"view": _FLOAT, "visible": _FLOAT}
_INPUTS = {
    "scene": {"size": _INTEGER},
    "generic": dict.fromkeys(("means", "cholesky", "colors"), _FLOAT)
    | dict.fromkeys(("region_ids", "labels"), _INTEGER),
}
_FLOATS = {"F32": "<f4", "F64": "<f8"}
_INTEGERS = {"U8": "u1", "U16": "<u2", "I32": "<i4", "I64": "<i8"}
_REQUIRED = ("means", "cholesky", "colors")
_TENSORS = dict.fromkeys((*_REQUIRED, "opacities"), _FLOATS) | dict.fromkeys(("region_ids", "labels"), _INTEGERS)
_DEFLATED = "labels_deflate"
_TENSORS[_DEFLATED] = {"U8": "u1"}
_TYPES = {"uint8": "u1", "uint16": "<u2", "int32": "<i4", "int64": "<i8"}
_LARGEST, _SMALLEST = 1e8, 1e-6  # pixels: what kcgs itself renders
_COLOR_TYPES = {1: 0, 3: 2, 4: 6}  # of PNG, by number of channels

Array = np.ndarray[Any, Any]
View = tuple[float, float, float, float]


class DecodeError(Exception):
    """What went wrong, in one line for the person at the terminal."""


@dataclass(frozen=True)
class Decoder:
    """A decoder that is ready to run."""

    path: Path
    session: onnxruntime.InferenceSession
    notes: Mapping[str, str]
    inputs: frozenset[str]
    load_ms: float


@dataclass(frozen=True)
class Scene:
    """Gaussians, and the labels to render them with (None: one region)."""

    means: Array  # (N, 2)
    cholesky: Array  # (N, 3)
    colors: Array  # (N, C), opacities multiplied in
    region_ids: Array  # (N,) int64
    labels: Array | None  # (H, W) int64
    size: tuple[int, int]  # (height, width)


def open_decoder(path: Path, providers: Sequence[str], threads: int) -> Decoder:
    """Load a decoder and check that it is one."""
    available = onnxruntime.get_available_providers()
    absent = [name for name in providers if name not in available]
    if absent:
        raise DecodeError(f"--providers: {', '.join(absent)} not available here; there are {', '.join(available)}")
    start = time.perf_counter()
    content = _read(path)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors come as exceptions, and are told once
    options.intra_op_num_threads = threads
    try:
        session = onnxruntime.InferenceSession(content, options, providers=list(providers), enable_fallback=0)
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        raise DecodeError(f"onnxruntime cannot load {path}: {_short(error, 300)}") from error
    load_ms = (time.perf_counter() - start) * 1e3
    # onnxruntime goes on without a provider that does not start
    idle = [name for name in providers if name not in session.get_providers()]
    if idle:
        raise DecodeError(f"--providers: {', '.join(idle)} did not start here; what did: {session.get_providers()}")
    notes = session.get_modelmeta().custom_metadata_map
    return Decoder(path, session, notes, _check_decoder(path, session, notes), load_ms)


def _check_decoder(path: Path, session: onnxruntime.InferenceSession, notes: Mapping[str, str]) -> frozenset[str]:
    expected = {"format": (_FORMAT,), "format_version": (_VERSION,), "kind": tuple(_INPUTS)}
    for key, values in expected.items():
        if notes.get(key) not in values:
            raise DecodeError(f"{path} is not a decoder: {key} must be {' or '.join(values)}; got {notes.get(key)!r}")
    inputs = {value.name: value.type for value in session.get_inputs()}
    required = _INPUTS[notes["kind"]]
    known = required | _OPTIONAL if notes["kind"] == "scene" else required
    if not required.keys() <= inputs.keys() or not inputs.items() <= known.items():
        raise DecodeError(f"{path} is not a {notes['kind']} decoder: its inputs must be {known}; got {inputs}")
    if [value.name for value in session.get_outputs()] != ["image"]:
        raise DecodeError(f"{path} is not a decoder: its output must be image")
    return frozenset(inputs)


def run(decoder: Decoder, feeds: Mapping[str, Array], size: tuple[int, int]) -> Array:
    """Render once, (C, H, W)."""
    try:
        image: Array = decoder.session.run(["image"], dict(feeds))[0]
    except Exception as error:  # as above
        raise DecodeError(f"{decoder.path} failed at {size[1]}x{size[0]}: {_short(error, 300)}") from error
    height, width = feeds["labels"].shape if "labels" in feeds else size
    if image.ndim != 4 or image.shape[0] != 1 or image.shape[2:] != (height, width):
        raise DecodeError(f"{decoder.path} must give an image of shape (1, C, {height}, {width}); got {image.shape}")
    return shrink(np.asarray(image[0]), size)


def shrink(image: Array, size: tuple[int, int]) -> Array:
    """Reduce an image (C, H, W): each pixel is the mean over its share of the height and width."""
    down, across = (_shares(old, new) for old, new in zip(image.shape[1:], size, strict=True))
    return image if image.shape[1:] == size else np.asarray(down @ image @ across.T)


def _shares(old: int, new: int) -> Array:
    begin, line = np.arange(new)[:, None] * old, np.arange(old) * new
    overlap = np.minimum(begin + old, line + new) - np.maximum(begin, line)
    return (overlap.clip(0) / old).astype(np.float32)


def scene_feeds(decoder: Decoder, args: argparse.Namespace) -> tuple[dict[str, Array], tuple[int, int]]:
    """Inputs of a scene decoder, and the image's size."""
    own = _note_side(decoder.path, decoder.notes, "height"), _note_side(decoder.path, decoder.notes, "width")
    for option, given, name in (("--view", args.view, "view"), ("--region", args.region, "visible")):
        if given is not None and name not in decoder.inputs:
            raise DecodeError(f"{option} needs an interactive decoder, with the input {name}; {decoder.path} has none")
    size = target_size(args, own)
    feeds: dict[str, Array] = {"size": np.array(size, np.int64)}
    if "view" in decoder.inputs:
        feeds["view"] = np.array(args.view or (0, 0, own[1], own[0]), np.float32)
    if "visible" in decoder.inputs:
        try:
            ids = np.array(json.loads(decoder.notes.get("region_ids", "")), np.int64).reshape(-1)
        except (ValueError, TypeError, OverflowError, RecursionError):
            raise DecodeError(f"{decoder.path} is damaged: its region_ids must be a JSON list of integers") from None
        feeds["visible"] = _chosen(ids, ids, args.region).astype(np.float32)
    return feeds, size


def generic_feeds(scene: Scene, args: argparse.Namespace) -> tuple[dict[str, Array], tuple[int, int]]:
    """Inputs of a generic decoder, and the image's size, which may be smaller than that of the labels."""
    size = target_size(args, scene.size)
    left, top, right, bottom = args.view or (0.0, 0.0, float(scene.size[1]), float(scene.size[0]))
    # of a smaller image pixels no larger than the scene's are rendered first
    extents, whole = (bottom - top, right - left), scene.size
    needed = [min(math.ceil(extents[k] - 1 / 256), 2 * whole[k]) for k in (0, 1)]
    finer = max(size[0], needed[0]), max(size[1], needed[1])
    labels = scene.labels
    if labels is None:
        labels = np.zeros(finer, np.int64)
    elif labels.shape == size != scene.size and not args.view:
        finer = size
    elif labels.shape != scene.size:
        raise DecodeError(f"{args.scene}: labels must have the size {scene.size} of the scene; got {labels.shape}")
    elif args.view or labels.shape != finer:
        labels = sample_labels(labels, finer, args.view)
    down, across = finer[0] / (bottom - top), finer[1] / (right - left)
    keep = _chosen(scene.region_ids, np.zeros(1, np.int64) if scene.labels is None else scene.labels, args.region)
    # in the scene's own precision, as kcgs scales it
    dtype = scene.means.dtype.type
    means = (scene.means - [dtype(left), dtype(top)]) * [dtype(across), dtype(down)]
    cholesky = scene.cholesky * np.array([across, down, down], scene.cholesky.dtype)
    if max(abs(means).max(initial=0), abs(cholesky).max(initial=0)) > _LARGEST or (cholesky[:, ::2] < _SMALLEST).any():
        raise DecodeError(
            f"{args.scene}: Gaussians must lie within {_LARGEST:g} pixels, {_SMALLEST:g} to {_LARGEST:g} wide"
        )
    feeds = {"means": means, "cholesky": cholesky, "colors": scene.colors}
    feeds = {name: array[keep].astype(np.float32) for name, array in feeds.items()}
    return feeds | {"region_ids": scene.region_ids[keep], "labels": labels}, size


def _chosen(ids: Array, known: Array, wanted: Sequence[int] | None) -> Array:
    if wanted is None:
        return np.ones(len(ids), bool)
    for region in wanted:
        if not (known == region).any():
            choice = _short(np.unique(known).tolist())
            raise DecodeError(f"--region must be among the scene's regions {choice}; got {region}")
    return np.isin(ids, wanted)


def target_size(args: argparse.Namespace, own: tuple[int, int]) -> tuple[int, int]:
    """Height and width of the image: as asked, or those of the view at a scale."""
    if args.size is not None:
        sides = args.size
    else:
        height, width = (args.view[3] - args.view[1], args.view[2] - args.view[0]) if args.view else own
        # compared before rounding, which an infinite side has not
        sides = [min(side * args.scale, MAX_SIDE + 1.0) for side in (height, width)]
        sides = [max(1, round(side)) for side in sides]
    if not all(1 <= side <= MAX_SIDE for side in sides):
        raise DecodeError(f"the image must have 1 to {MAX_SIDE} pixels a side; got {sides[1]}x{sides[0]}")
    needed = _PIXEL_BYTES * sides[0] * sides[1]
    if hasattr(os, "sysconf") and needed > (memory := os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")):
        gigabytes = f"{needed / 1e9:,.1f} GB of memory; this machine has {memory / 1e9:,.1f} GB"
        raise DecodeError(f"an image of {sides[1]}x{sides[0]} pixels needs about {gigabytes}")
    return sides[0], sides[1]


def sample_labels(labels: Array, size: tuple[int, int], view: View | None = None) -> Array:
    """Sample a label map at another size: the label with the largest share among the four neighbours."""
    left, top, right, bottom = view or (0.0, 0.0, float(labels.shape[1]), float(labels.shape[0]))
    rows = _neighbours(size[0], top, bottom - top, labels.shape[0])
    columns = _neighbours(size[1], left, right - left, labels.shape[1])
    sampled = np.empty(size, np.int64)
    for start in range(0, size[0], 64):  # by blocks, so that the work stays small beside the result
        part = slice(start, start + 64)
        block = [labels[r[part, None], c] for r in rows[:2] for c in columns[:2]]
        shares = [r[part, None] * c for r in rows[2:] for c in columns[2:]]
        mixed = np.nonzero((block[0] != block[1]) | (block[0] != block[2]) | (block[0] != block[3]))
        ours = np.stack([b[mixed] for b in block])
        weights = np.stack([s[mixed] for s in shares])
        score = [(weights * (ours == candidate)).sum(0) for candidate in ours]
        sampled[part] = block[0]
        sampled[part][mixed] = np.take_along_axis(ours, np.argmax(score, 0)[None], 0)[0]
    return sampled


def _neighbours(count: int, start: float, extent: float, length: int) -> tuple[Array, Array, Array, Array]:
    # whole parts of a pixel: a label falls on the same side in every program
    begin, long = (round(value * _PARTS) for value in (start, extent))
    whole = 2 * count * _PARTS
    at = (2 * np.arange(count) + 1) * long + 2 * count * begin - count * _PARTS
    index = at // whole
    # odd multiples of 1 / 2048: no two labels can have the same share
    second = 2 * ((at - index * whole) * 1024 // whole) + 1
    return index.clip(0, length - 1), (index + 1).clip(0, length - 1), 2048 - second, second


def read_scene(path: Path) -> Scene:
    """Read a scene that a generic decoder can render."""
    tensors, notes = _read_safetensors(path)
    if notes.get("format") != _SCENE_FORMAT or notes.get("format_version") not in _SCENE_VERSIONS:
        found = notes.get("format"), notes.get("format_version")
        raise DecodeError(f"{path} is not a scene: its format must be {_SCENE_FORMAT}, version 1 to 3; got {found}")
    _check_contours(path, notes)
    _check_shapes(path, tensors)
    size = _note_side(path, notes, "height"), _note_side(path, notes, "width")
    for name, array in tensors.items():
        if not np.isfinite(array).all():
            raise DecodeError(f"{path}: {name} must be finite; got NaN or infinite values")
        if name in ("region_ids", "labels") and array.min(initial=0) < 0:
            raise DecodeError(f"{path}: {name} must be non-negative; got {array.min()}")
    if not (tensors["cholesky"][:, ::2] > 0).all():
        raise DecodeError(f"{path}: cholesky must have l11 > 0 and l22 > 0")
    colors = tensors["colors"]
    if "opacities" in tensors:
        colors = colors * tensors["opacities"][:, None]
    if "labels" not in tensors:
        return Scene(tensors["means"], tensors["cholesky"], colors, np.zeros(len(colors), np.int64), None, size)
    if "region_ids" not in tensors:
        raise DecodeError(f"{path}: it must hold region_ids where it holds labels")
    ids, labels = (tensors[name].astype(np.int64) for name in ("region_ids", "labels"))
    return Scene(tensors["means"], tensors["cholesky"], colors, ids, labels, size)


def _check_contours(path: Path, notes: Mapping[str, str]) -> None:
    for name, plain in (("softness", 0.0), ("supersample", 1.0)):
        if name in notes and _number(notes[name]) != plain:
            what = f"soft or finer contours ({name} {_short(notes[name])})"
            raise DecodeError(f"{path} has {what}; a generic decoder renders hard ones: export the scene's own decoder")


def _check_shapes(path: Path, tensors: Mapping[str, Array]) -> None:
    missing = [name for name in _REQUIRED if name not in tensors]
    if missing:
        raise DecodeError(f"{path} is not a scene: {', '.join(missing)} missing")
    count = len(tensors["means"]) if tensors["means"].ndim == 2 else -1
    channels = tensors["colors"].shape[-1] if tensors["colors"].ndim else 0
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 2),
        "cholesky": (count, 3),
        "colors": (count, max(1, channels)),
    }
    shapes |= {"opacities": (count,), "region_ids": (count,)}
    for name, shape in shapes.items():
        if name in tensors and tensors[name].shape != shape:
            wanted = ", ".join(["N", *map(str, shape[1:])])
            raise DecodeError(f"{path}: {name} must have shape ({wanted}), of one scene; got {tensors[name].shape}")
    labels = tensors.get("labels")
    if labels is not None and (labels.ndim != 2 or not labels.size or max(labels.shape) > MAX_SIDE):
        raise DecodeError(f"{path}: labels must have shape (H, W), 1 to {MAX_SIDE} a side; got {labels.shape}")


def _read_safetensors(path: Path) -> tuple[dict[str, Array], dict[str, str]]:
    content = _read(path)
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or length > len(content) - 8:
        raise DecodeError(f"{path} is not a .safetensors file, or is truncated: {len(content)} bytes")
    try:
        header = json.loads(content[8 : 8 + length].decode())
        notes = header.pop("__metadata__", {})
        if not all(isinstance(value, str) for value in notes.values()):
            raise ValueError("metadata must be strings")
        tensors = {name: _read_tensor(content, 8 + length, name, header[name]) for name in header}
        if _DEFLATED in tensors:
            tensors["labels"] = _inflate(tensors.pop(_DEFLATED), notes)
        return tensors, notes
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, zlib.error) as error:
        raise DecodeError(f"{path} is not a .safetensors file, or is truncated: {_short(error, 300)}") from error


def _read_tensor(content: bytes, base: int, name: str, entry: Mapping[str, Any]) -> Array:
    dtypes = _TENSORS.get(name)
    if dtypes is None:
        raise ValueError(f"a scene holds {', '.join(_TENSORS)}; got {_short(name)!r}")
    if entry["dtype"] not in dtypes:
        raise ValueError(f"{name} must have a dtype among {', '.join(dtypes)}; got {_short(entry['dtype'])}")
    dtype, shape, (start, stop) = np.dtype(dtypes[entry["dtype"]]), entry["shape"], entry["data_offsets"]
    if not all(type(n) is int and n >= 0 for n in (*shape, start, stop)):
        raise ValueError(f"{name} must have a shape and offsets of whole numbers")
    if not start <= stop <= len(content) - base or stop - start != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{name} lies at {start}:{stop} of {len(content) - base} bytes; its shape is {_short(shape)}")
    return np.frombuffer(content, dtype, math.prod(shape), base + start).reshape(shape)


def _inflate(data: Array, notes: Mapping[str, str]) -> Array:
    """Unpack a label map: each row is what it differs by from the row above it."""
    shape, dtype = json.loads(notes["labels_shape"]), np.dtype(_TYPES[notes["labels_type"]])
    if len(shape) not in (2, 3) or not all(type(n) is int and 0 < n <= MAX_SIDE for n in shape):
        raise ValueError(f"labels_shape must hold 1 to {MAX_SIDE} a side; got {_short(shape)}")
    size = math.prod(shape) * dtype.itemsize
    raw = zlib.decompressobj().decompress(data.tobytes(), size + 1)
    if len(raw) != size:
        raise ValueError(f"{_DEFLATED} must unpack to {size} bytes; got {len(raw)}")
    return np.add.accumulate(np.frombuffer(raw, dtype).reshape(shape), axis=-2, dtype=dtype)


def _note_side(path: Path, notes: Mapping[str, str], name: str) -> int:
    text = notes.get(name, "")
    if not re.fullmatch("[0-9]{1,8}", text) or not 1 <= int(text) <= MAX_SIDE:
        raise DecodeError(f"{path}: its {name} must be a whole number of 1 to {MAX_SIDE} pixels; got {_short(text)!r}")
    return int(text)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror}") from error


def _short(value: object, most: int = 80) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= most else text[: most - 3] + "..."


def check_output(path: Path) -> None:
    """Refuse a path that could not be written, before the work."""
    if path.suffix not in (".png", ".npy"):
        raise DecodeError(f"-o must end in .png or .npy; got {path}")
    if not path.parent.is_dir():
        raise DecodeError(f"cannot write {path}: the folder {path.parent} does not exist")
    if path.is_dir():
        raise DecodeError(f"cannot write {path}: it is a folder")


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".tmp-{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise DecodeError(f"cannot write {path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_image(path: Path, image: Array) -> None:
    """Write (C, H, W) as an 8-bit PNG, or as it is, as .npy; the file appears whole or not at all."""
    if not np.isfinite(image).all():
        raise DecodeError(f"the decoder gave NaN or infinite values, {(~np.isfinite(image)).sum()} of {image.size}")
    if path.suffix == ".png" and image.shape[0] not in _COLOR_TYPES:
        raise DecodeError(f"a PNG has 1, 3 or 4 channels; got {image.shape[0]}: write a .npy file")
    with _whole(path) as temporary:
        if path.suffix == ".npy":
            np.save(temporary, image)
        else:
            temporary.write_bytes(encode_png(np.floor(np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)))


def encode_png(levels: Array) -> bytes:
    """Encode (C, H, W) of uint8, C = 1, 3 or 4."""
    channels, height, width = levels.shape
    lines = np.ascontiguousarray(levels.transpose(1, 2, 0)).reshape(height, width * channels)
    # filter 2, the difference to the line above: smooth images get smaller
    filtered = np.empty((height, 1 + width * channels), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = lines[0]
    np.subtract(lines[1:], lines[:-1], out=filtered[1:, 1:])
    data = zlib.compress(filtered.tobytes())
    header = struct.pack(">IIBBBBB", width, height, 8, _COLOR_TYPES[channels], 0, 0, 0)
    step = 1 << 24
    chunks = [(b"IHDR", header), *((b"IDAT", data[at : at + step]) for at in range(0, len(data), step)), (b"IEND", b"")]
    parts = [b"\x89PNG\r\n\x1a\n"]
    for name, body in chunks:
        parts += [struct.pack(">I", len(body)), name, body, struct.pack(">I", zlib.crc32(name + body))]
    return b"".join(parts)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (--help shows how)\n")


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch("([0-9]{1,18})[xX]([0-9]{1,18})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"must be WxH, such as 640x480; got {text!r}")
    return int(match[2]), int(match[1])


def _scale(text: str) -> float:
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a positive number; got {text!r}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _view(text: str) -> View:
    numbers = [_number(part) for part in text.split(",")]
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"must be LEFT,TOP,RIGHT,BOTTOM in pixels of the scene; got {text!r}")
    left, top, right, bottom = numbers
    if not (left < right and top < bottom) or max(map(abs, numbers)) > MAX_SIDE:
        raise argparse.ArgumentTypeError(f"must have LEFT < RIGHT and TOP < BOTTOM, up to {MAX_SIDE}; got {text!r}")
    return left, top, right, bottom


def _count(text: str) -> int:
    if not re.fullmatch("[0-9]{1,6}", text) or not int(text):
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 999999; got {text!r}")
    return int(text)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = _Parser(prog="decode.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("decoder", type=Path, help="decoder (.onnx)")
    parser.add_argument("scene", type=Path, nargs="?", help="scene (.safetensors), for a generic decoder")
    parser.add_argument("-o", "--output", type=Path, required=True, help="8-bit .png, or .npy of floats (C, H, W)")
    target = parser.add_mutually_exclusive_group()
    target.add_argument("--scale", type=_scale, default=1.0, help="magnification")
    target.add_argument("--size", type=_size, metavar="WxH", help="width and height in pixels")
    view_help = "part of the scene that fills the image, in its pixels (--view=-5,... where the first is negative)"
    parser.add_argument("--view", type=_view, metavar="LEFT,TOP,RIGHT,BOTTOM", help=view_help)
    parser.add_argument("--region", type=int, nargs="+", action="extend", metavar="ID", help="only these regions")
    parser.add_argument(
        "--providers", type=lambda text: text.split(","), default=["CPUExecutionProvider"], help="separated by commas"
    )
    parser.add_argument("--threads", type=_count, default=0, help="default: onnxruntime's choice")
    parser.add_argument("--repeat", type=_count, help="time this many runs, after one to warm up")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser.parse_args(argv)


def decode(args: argparse.Namespace) -> dict[str, object]:
    """Decode one image, write it, and return what there is to report."""
    check_output(args.output)
    decoder = open_decoder(args.decoder, args.providers, args.threads)
    if decoder.notes["kind"] == "scene":
        if args.scene is not None:
            raise DecodeError(f"{args.decoder} holds its own scene; leave out {args.scene}")
        feeds, size = scene_feeds(decoder, args)
    else:
        if args.scene is None:
            raise DecodeError(f"{args.decoder} is a generic decoder: give a scene (.safetensors) after it")
        feeds, size = generic_feeds(read_scene(args.scene), args)
    times = []
    for _ in range(1 + args.repeat if args.repeat else 1):
        start = time.perf_counter()
        image = run(decoder, feeds, size)
        times.append((time.perf_counter() - start) * 1e3)
    write_image(args.output, image)
    return {
        "output": str(args.output),
        "kind": decoder.notes["kind"],
        "width": size[1],
        "height": size[0],
        "channels": image.shape[0],
        "providers": decoder.session.get_providers(),
        "bytes": args.decoder.stat().st_size,
        "load_ms": round(decoder.load_ms, 3),
        "decode_ms": round(statistics.median(times[1:] or times), 3),
        "repeat": args.repeat or 1,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    args = parse(argv)
    try:
        with np.errstate(all="ignore"):  # values out of range are refused where they matter
            report = decode(args)
    except (DecodeError, MemoryError, KeyboardInterrupt) as error:
        what = {MemoryError: "not enough memory for this image", KeyboardInterrupt: "interrupted, nothing written"}
        print("decode.py:", what.get(type(error), error), file=sys.stderr)
        return 130 if isinstance(error, KeyboardInterrupt) else 1
    if args.json:
        print(json.dumps(report))
    elif args.repeat:
        print("loaded in {load_ms} ms, decoded in {decode_ms} ms (median of {repeat})".format(**report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
