"""The shape of the code: layers and private names."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import kcgs

PACKAGE = Path(kcgs.__file__).resolve().parent
ROOT = PACKAGE.parent
# a room imports itself and what is below it
LAYERS = [
    {"cli"},
    {"bench"},
    {"view", "zoo", "plots"},
    {"rate"},
    {"fit", "codec", "onnx", "segment"},
    {"data", "editing", "evaluate", "pruning", "storage"},
    {"scene"},
    {"nn"},
    {"functional"},
    {"kernels"},
    {"_check", "_atomic", "_shipped", "engine"},
]


def modules() -> dict[str, Path]:
    names = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        names[".".join(parts).removesuffix(".__init__")] = path
    return names


def imports(name: str, path: Path, known: set[str]) -> Iterator[str]:
    """Every module that this one imports anywhere: at the top, in a function, or for its types."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                full = f"{source}.{alias.name}"
                if full in known or source in known:
                    yield full if full in known else source


def graph() -> dict[str, set[str]]:
    known = modules()
    return {
        name: {other for other in imports(name, path, set(known)) if other != name and not name.startswith(f"{other}.")}
        for name, path in known.items()
    }


def test_imports_go_one_way() -> None:
    level = {room: height for height, rooms in enumerate(LAYERS) for room in rooms}
    for name, others in graph().items():
        if name == "kcgs":
            continue
        room = name.split(".")[1]
        for other in others - {"kcgs"}:
            target = other.split(".")[1]
            assert target == room or level[target] > level[room], f"{name} imports {other}"


def test_private_names_of_maps_stay_below() -> None:
    """What a RegionMap keeps to itself is read in functional and kernels only."""
    for name, path in modules().items():
        if not name.startswith(("kcgs.functional", "kcgs.kernels")):
            assert not re.search(r"regions?\._[a-z]|membership\._[a-z]", path.read_text()), name
