"""The web's decoder behind a pipe (export/web/test/decode.mjs), and what Python makes of the same files."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kcgs import Clip
from kcgs.codec import CodecError, decode, decode_labels
from kcgs.codec.clips.file import unpack as unpack_clip

from .browser import WEB, Browser, Pipe


class Reader(Protocol):
    """The web's decoder, wherever it runs."""

    def do(self, action: str, data: bytes) -> dict[str, Any]:
        """Describe a scene or labels, or the error."""


class Node(Pipe):
    """The built decoder in node: one command at a time."""

    def __init__(self, bundle: Path, scratch: Path) -> None:
        super().__init__("--expose-gc", str(WEB / "test" / "decode.mjs"), str(bundle), errors=scratch / "errors.txt")
        self._file = scratch / "bytes.kcgs"

    def do(self, action: str, data: bytes, **arguments: Any) -> dict[str, Any]:
        self._file.write_bytes(data)
        return self.ask(action, path=str(self._file), **arguments)


class Page:
    """The built decoder in a browser; scenes only."""

    def __init__(self, browser: Browser, folder: Path) -> None:
        self._browser, self._file = browser, folder / "scene.kcgs"

    def do(self, action: str, data: bytes) -> dict[str, Any]:
        assert action == "scene"
        self._file.write_bytes(data)
        answer: dict[str, Any] = self._browser.evaluate("kcgs.describe('scene.kcgs')")
        return answer


def digest(array: Any, dtype: str = "<f4") -> str:
    numbers: NDArray[Any] = np.ascontiguousarray(array, dtype=dtype)
    return hashlib.sha256(numbers.tobytes()).hexdigest()


def scene_of(data: bytes) -> dict[str, Any]:
    """Decode in Python; describe it as describe.mjs does."""
    found = decode(data)
    field, regions = found.scene.field, found.scene.regions
    numbers = {name: getattr(field, name).detach().numpy() for name in ("means", "cholesky", "colors")}
    described: dict[str, Any] = {name: digest(array) for name, array in numbers.items()}
    described |= {"height": field.size[0], "width": field.size[1], "channels": field.colors.shape[-1]}
    described |= {"count": len(field), "layers": found.layers, "complete": found.layers == found.num_layers}
    described |= {"regions": None, "regionIds": None, "positions": None, "exactIds": None}
    if regions is None or field.region_ids is None:
        return described
    labels, ids = regions.index_of(regions.fine_labels).numpy(), regions.ids.numpy()
    described["regionIds"] = digest(field.region_ids.numpy(), "<f8")
    described["positions"] = digest(regions.index_of(field.region_ids).numpy(), "<i4")
    described["exactIds"] = digest(ids, "<i8")
    one = isinstance(regions.softness, float)
    described["regions"] = {
        "supersample": regions.supersample, "labels": digest(labels, "<i4"), "ids": digest(ids, "<f8"),
        "softness": regions.softness if one else None,
        "pairs": [] if one else [[*np.searchsorted(ids, pair).tolist(), w] for pair, w in regions.softness.items()],
    }  # fmt: skip
    return described


def labels_of(data: bytes) -> dict[str, Any]:
    labels = decode_labels(data).numpy()
    described = digest(labels, labels.dtype.str)
    return {"height": labels.shape[0], "width": labels.shape[1], "type": str(labels.dtype), "labels": described}


def frame_of(clip: Clip, number: int) -> dict[str, Any]:
    """Decode a frame in Python; describe it as describe.mjs does, but for what is the same in all frames."""
    scene = clip[number]
    field, regions, keys = scene.field, scene.regions, clip._frame(number)[1].key
    numbers = {name: getattr(field, name).detach().numpy() for name in ("means", "cholesky", "colors")}
    described: dict[str, Any] = {name: digest(array) for name, array in numbers.items()}
    described |= {"count": len(field), "keys": digest(keys, "<i4"), "regionIds": None, "regions": None}
    if regions is None or field.region_ids is None:
        return described
    pairs = {} if isinstance(regions.softness, float) else regions.softness
    widths = {regions.softness} if isinstance(regions.softness, float) else set(pairs.values())
    one = len(widths) == 1  # whether it is said once, or for each pair
    described["regionIds"] = digest(field.region_ids.numpy(), "<f8")
    described["regions"] = {
        "labels": digest(regions.labels.numpy(), "<f8"), "softness": widths.pop() if one else None,
        "pairs": [] if one else sorted([*pair, width] for pair, width in pairs.items()),
    }  # fmt: skip
    return described


def check_clip(reader: Node, data: bytes) -> int:
    """Both give the same frames, up to the same one that both refuse; return how many they gave."""
    try:
        clip = Clip.from_bytes(data, whole=False)
    except CodecError as error:
        assert reader.do("clip", data)["error"] == "DecodeError", str(error)
        return 0
    wanted = []
    try:
        wanted.extend(frame_of(clip, number) for number in range(len(clip)))
    except CodecError as error:
        answer = reader.do("clip", data, numbers=[len(wanted)])
        assert answer.get("error") == "DecodeError", (str(error), answer)
    answer = reader.do("clip", data, numbers=[*range(len(wanted))])
    for found, frame in zip(answer.pop("described"), wanted, strict=True):
        if found["regions"] is not None:
            found["regions"] = {name: found["regions"][name] for name in ("labels", "softness", "pairs")}
        assert {name: found[name] for name in frame} == frame
    answer.pop("memory")
    height, width = clip.size
    assert answer == {
        "size": {"height": height, "width": width}, "channels": clip[0].field.colors.shape[-1] if wanted else 3,
        "frameRate": float(clip.frame_rate), "frames": len(clip), "keyFrames": list(clip.key_frames),
        "complete": unpack_clip(data)[2],
    }  # fmt: skip
    return len(wanted)


def check_same(reader: Reader, data: bytes, *, labels: bool = False) -> bool:
    """Both give the same bits, or both refuse; return whether they gave any."""
    answer = reader.do("labels" if labels else "scene", data)
    answer.pop("memory", None)
    try:
        expected = (labels_of if labels else scene_of)(data)
    except CodecError as error:
        assert answer.get("error") == "DecodeError", (str(error), answer)
        return False
    assert answer == expected
    return True
