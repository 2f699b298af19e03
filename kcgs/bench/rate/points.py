"""What was measured of a file, and the folder that keeps both."""

from __future__ import annotations

import ast
import hashlib
import json
import math
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from kcgs._atomic import atomic_path

KCGS, NO_REGIONS, FLOAT = "kcgs", "kcgs, no regions", "float scene"
# a codec of label maps
LABELS, LOSSLESS_WEBP = "kcgs.codec.labels", "WebP, lossless"
TUNED, PLAIN, DECODE = "encode, fine-tuned", "encode", "decode"


class Point(NamedTuple):
    """A file, or the scene before it is one."""

    group: str
    image: str
    codec: str
    asked: int  # bytes that it may have; in the groups precision and speed: how many Gaussians
    bytes: int
    bpp: float  # bits a pixel, everything included
    setting: str = ""
    psnr: float = math.nan
    ms_ssim: float = math.nan
    ef_psnr: float = math.nan
    ef_ssim: float = math.nan
    encode_seconds: float = math.nan  # of kcgs: the fit included
    decode_seconds: float = math.nan
    num_gaussians: int = 0
    regions: int = 0  # of the map in the file, 1: there is none


class Ask(NamedTuple):
    """Which file: a point's first fields, and whether it is the short form's."""

    group: str
    image: str
    codec: str
    asked: int
    quick: bool


class Store:
    """Points in a folder, a JSON file each, beside the files that they are of.

    Names hold a hash of all that a file depends on: of kcgs files also the codec.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def path(self, ask: Ask, settings: Any, suffix: str) -> Path:
        """Say where a file is, or would be."""
        parts = json.dumps([*ask, settings, Point._fields], sort_keys=True)
        name = "-".join([ask.group, ask.image, ask.codec, str(ask.asked)])
        name = "".join(c if c.isalnum() or c in "-." else "_" for c in name)
        return self._folder / f"{name}-{hashlib.sha256(parts.encode()).hexdigest()[:16]}.{suffix}"

    def read(self, ask: Ask, settings: Any) -> Point | None:
        """Return a point, None where there is none."""
        path = self.path(ask, settings, "json")
        return Point(**json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None

    def write(self, ask: Ask, settings: Any, point: Point, data: bytes | None = None) -> Point:
        """Keep a point, and its file."""
        if data is not None:
            with atomic_path(self.path(ask, settings, "file")) as temporary:
                temporary.write_bytes(data)
        with atomic_path(self.path(ask, settings, "json")) as temporary:
            temporary.write_text(json.dumps(point._asdict()), encoding="utf-8")
        return point


@cache
def codec_digest() -> str:
    """Hash the format's version and the code that writes files; comments and docstrings do not count."""
    import kcgs.codec
    from kcgs.codec.file import VERSION

    folder = Path(kcgs.codec.__file__).parent
    sources = [*sorted(folder.rglob("*.py")), *sorted((folder.parent / "rate").glob("*.py"))]
    digest = hashlib.sha256(bytes([VERSION]))
    for path in sources:
        digest.update(code_of(path.read_text(encoding="utf-8")).encode())
    for path in sorted(folder.rglob("*.bin")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def code_of(source: str) -> str:
    """Return what of a module is code.

    Example:
        >>> code_of("x = 1  # one") == code_of('"Ones."; x = 1') != code_of("x = 2")
        True
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [line for line in node.body if not _is_text(line)]
    return ast.dump(tree)


def _is_text(line: ast.stmt) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)
