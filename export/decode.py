# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy>=1.26", "onnxruntime>=1.20"]
# ///
"""Decode kcgs scenes with numpy and onnxruntime alone: `python decode.py decoder.onnx -o image.png --scale 4`."""

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
_INPUTS = {"size": "tensor(int64)", "view": "tensor(float)", "visible": "tensor(float)"}  # the first is required
_COLOR_TYPES = {1: 0, 3: 2, 4: 6}  # of PNG, by number of channels

Array = np.ndarray[Any, Any]
View = tuple[float, float, float, float]


class DecodeError(Exception):
    """An error with a message of one line, which the command prints."""


@dataclass(frozen=True)
class Decoder:
    """A decoder that is ready to run."""

    path: Path
    session: onnxruntime.InferenceSession
    metadata: Mapping[str, str]
    inputs: frozenset[str]
    load_ms: float


def open_decoder(path: Path, providers: Sequence[str], threads: int) -> Decoder:
    """Load a decoder and check that it is one."""
    available = onnxruntime.get_available_providers()
    absent = [name for name in providers if name not in available]
    if absent:
        raise DecodeError(f"--providers: {', '.join(absent)} not available here; there are {', '.join(available)}")
    start = time.perf_counter()
    content = _read(path)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors come as exceptions, and are printed once
    options.intra_op_num_threads = threads
    try:
        session = onnxruntime.InferenceSession(content, options, providers=list(providers), enable_fallback=0)
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        raise DecodeError(f"onnxruntime cannot load {path}: {_shorten(error, 300)}") from error
    load_ms = (time.perf_counter() - start) * 1e3
    # if a provider does not start, onnxruntime goes on without it
    idle = [name for name in providers if name not in session.get_providers()]
    if idle:
        raise DecodeError(f"--providers: {', '.join(idle)} did not start here; what did: {session.get_providers()}")
    try:
        metadata = session.get_modelmeta().custom_metadata_map
        return Decoder(path, session, metadata, _check_decoder(path, session, metadata), load_ms)
    except UnicodeDecodeError as error:  # names and metadata are texts
        raise DecodeError(f"{path} is damaged: {error}") from error


def _check_decoder(path: Path, session: onnxruntime.InferenceSession, metadata: Mapping[str, str]) -> frozenset[str]:
    for key, value in (("format", _FORMAT), ("format_version", _VERSION)):
        if metadata.get(key) != value:
            raise DecodeError(f"{path} is not a decoder: {key} must be {value}; got {metadata.get(key)!r}")
    inputs = {value.name: value.type for value in session.get_inputs()}
    if "size" not in inputs or not inputs.items() <= _INPUTS.items():
        raise DecodeError(f"{path} is not a decoder: its inputs must be {_INPUTS}; got {inputs}")
    if [value.name for value in session.get_outputs()] != ["image"]:
        raise DecodeError(f"{path} is not a decoder: its output must be image")
    return frozenset(inputs)


def run(decoder: Decoder, feeds: Mapping[str, Array], size: tuple[int, int]) -> Array:
    """Render once, (C, H, W)."""
    try:
        image: Array = decoder.session.run(["image"], dict(feeds))[0]
    except Exception as error:  # as above
        raise DecodeError(f"{decoder.path} failed at {size[1]}x{size[0]}: {_shorten(error, 300)}") from error
    if image.ndim != 4 or image.shape[0] != 1 or image.shape[2:] != size:
        raise DecodeError(f"{decoder.path} must give an image of shape (1, C, {size[0]}, {size[1]}); got {image.shape}")
    return np.asarray(image[0])


def scene_feeds(decoder: Decoder, args: argparse.Namespace) -> tuple[dict[str, Array], tuple[int, int]]:
    """Return the inputs of a scene decoder, and the size of the image."""
    scene_size = _read_side(decoder, "height"), _read_side(decoder, "width")
    for option, argument, name in (("--view", args.view, "view"), ("--region", args.region, "visible")):
        if argument is not None and name not in decoder.inputs:
            raise DecodeError(f"{option} needs an interactive decoder, with the input {name}; {decoder.path} has none")
    size = target_size(args, scene_size)
    feeds: dict[str, Array] = {"size": np.array(size, np.int64)}
    if "view" in decoder.inputs:
        feeds["view"] = np.array(args.view or (0, 0, scene_size[1], scene_size[0]), np.float32)
    if "visible" in decoder.inputs:
        try:
            ids = np.array(json.loads(decoder.metadata.get("region_ids", "")), np.int64).reshape(-1)
        except (ValueError, TypeError, OverflowError, RecursionError):
            raise DecodeError(f"{decoder.path} is damaged: its region_ids must be a JSON list of integers") from None
        feeds["visible"] = _select_regions(ids, args.region).astype(np.float32)
    return feeds, size


def _select_regions(ids: Array, selected: Sequence[int] | None) -> Array:
    if selected is None:
        return np.ones(len(ids), bool)
    for region in selected:
        if not (ids == region).any():
            raise DecodeError(f"--region must be among the scene's regions {_shorten(ids.tolist())}; got {region}")
    return np.isin(ids, selected)


def target_size(args: argparse.Namespace, scene_size: tuple[int, int]) -> tuple[int, int]:
    """Return height and width of the image: those of --size, or those of the view times the scale."""
    if args.size is not None:
        sides = args.size
    else:
        height, width = (args.view[3] - args.view[1], args.view[2] - args.view[0]) if args.view else scene_size
        # limited before the rounding, which raises if a side is infinite
        sides = [min(side * args.scale, MAX_SIDE + 1.0) for side in (height, width)]
        sides = [max(1, round(side)) for side in sides]
    if not all(1 <= side <= MAX_SIDE for side in sides):
        raise DecodeError(f"the image must have 1 to {MAX_SIDE} pixels a side; got {sides[1]}x{sides[0]}")
    needed = _PIXEL_BYTES * sides[0] * sides[1]
    if hasattr(os, "sysconf") and needed > (memory := os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")):
        gigabytes = f"{needed / 1e9:,.1f} GB of memory; this machine has {memory / 1e9:,.1f} GB"
        raise DecodeError(f"an image of {sides[1]}x{sides[0]} pixels needs about {gigabytes}")
    return sides[0], sides[1]


def _read_side(decoder: Decoder, name: str) -> int:
    text = decoder.metadata.get(name, "")
    if not re.fullmatch("[0-9]{1,8}", text) or not 1 <= int(text) <= MAX_SIDE:
        expected = f"a whole number of 1 to {MAX_SIDE} pixels"
        raise DecodeError(f"{decoder.path}: its {name} must be {expected}; got {_shorten(text)!r}")
    return int(text)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror}") from error


def _shorten(value: object, most: int = 80) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= most else text[: most - 3] + "..."


def check_output(path: Path) -> None:
    """Raise an error if a path cannot be written, before the work."""
    if path.suffix not in (".png", ".npy"):
        raise DecodeError(f"-o must end in .png or .npy; got {path}")
    if not path.parent.is_dir():
        raise DecodeError(f"cannot write {path}: the folder {path.parent} does not exist")
    if path.is_dir():
        raise DecodeError(f"cannot write {path}: it is a folder")


@contextmanager
def _atomic_path(path: Path) -> Iterator[Path]:
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
    with _atomic_path(path) as temporary:
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
    """Decode one image, write it, and return the report that --json prints."""
    check_output(args.output)
    decoder = open_decoder(args.decoder, args.providers, args.threads)
    feeds, size = scene_feeds(decoder, args)
    times = []
    for _ in range(1 + args.repeat if args.repeat else 1):
        start = time.perf_counter()
        image = run(decoder, feeds, size)
        times.append((time.perf_counter() - start) * 1e3)
    write_image(args.output, image)
    return {
        "output": str(args.output),
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
        with np.errstate(all="ignore"):  # checks raise errors for values out of range
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
