"""The web's decoder behind a pipe (export/web/test/decode.mjs), and what Python makes of the same files."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kcgs.codec import CodecError, decode

from .browser import WEB, Browser, Pipe


class Reader(Protocol):
    """The web's decoder, wherever it runs."""

    def do(self, action: str, data: bytes) -> dict[str, Any]:
        """Describe a scene, or the error."""


class Node(Pipe):
    """The built decoder in node: one command at a time."""

    def __init__(self, bundle: Path, scratch: Path) -> None:
        super().__init__("--expose-gc", str(WEB / "test" / "decode.mjs"), str(bundle), errors=scratch / "errors.txt")
        self._file = scratch / "bytes.kcgs"

    def do(self, action: str, data: bytes, **arguments: Any) -> dict[str, Any]:
        self._file.write_bytes(data)
        return self.ask(action, path=str(self._file), **arguments)


class Page:
    """The built decoder in a browser."""

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
    decoded = decode(data)
    field, regions = decoded.scene.field, decoded.scene.regions
    numbers = {name: getattr(field, name).detach().numpy() for name in ("means", "cholesky", "colors")}
    described: dict[str, Any] = {name: digest(array) for name, array in numbers.items()}
    described |= {"height": field.size[0], "width": field.size[1], "channels": field.colors.shape[-1]}
    described |= {
        "count": field.num_gaussians,
        "layers": decoded.layers,
        "complete": decoded.layers == decoded.num_layers,
    }
    described |= {"regions": None, "positions": None}
    if regions is None or field.region_ids is None:
        return described
    labels, ids = regions.index_of(regions.labels).numpy(), regions.ids.numpy()
    described["positions"] = digest(regions.index_of(field.region_ids).numpy(), "<i4")
    uniform = isinstance(regions.softness, float)
    described["regions"] = {
        "labels": digest(labels, "<i4"), "ids": digest(ids, "<f8"),
        "softness": regions.softness if uniform else None,
        "pairs": [] if uniform else [[*np.searchsorted(ids, pair).tolist(), w] for pair, w in regions.softness.items()],
    }  # fmt: skip
    return described


def check_same(reader: Reader, data: bytes) -> bool:
    """Both give the same bits, or both refuse; return whether they gave any."""
    answer = reader.do("scene", data)
    answer.pop("memory", None)
    try:
        expected = scene_of(data)
    except CodecError as error:
        assert answer.get("error") == "DecodeError", (str(error), answer)
        return False
    assert answer == expected
    return True
