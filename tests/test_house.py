"""The shape of the code: layers, no circles, short files, private names, and words that are gone."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

import kcgs

PACKAGE = Path(kcgs.__file__).resolve().parent
ROOT = PACKAGE.parent
# a room imports itself and what is below it
LAYERS = [
    {"cli"},
    {"zoo"},
    {"page"},
    {"rate", "video"},
    {"editing"},
    {"fitting", "codec", "onnx", "segment"},
    {"data", "evaluation", "pruning", "storage"},
    {"scene"},
    {"nn"},
    {"functional"},
    {"kernels", "engine", "plots"},
    {"_image"},
    {"_check", "_memory", "_atomic", "_progress", "_repr"},
    {"errors"},
]
GONE = {
    "image, render": r"\bpictures?\b|\bdraw(s|n|ing|ings)?\b",
    "merge cost": r"\bworth(less)?\b",
    "tile, mask, region weight, wavefront": r"\b(strips?|lanes?|waves?)\b",
    "Levenberg-Marquardt refinement": r"\bpolish\w*\b",
    "quantization parameter": r"\bnoise codes?\b",
    "per": r"\b(bits?|labels?|floats?|bytes|Gaussians?|integer) an? (pixel|Gaussian|image|file|core|thread)\b",
}
# names of libraries, an input inside decoders whose bytes stay, and English
ALLOWED = re.compile(r"skimage\.draw|ImageDraw(\.Draw)?|Gaussians a file may|\.strip\(")


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


def test_no_circle_of_imports() -> None:
    left = graph()
    while free := [name for name, others in left.items() if not others & left.keys()]:
        for name in free:
            del left[name]
    assert not left, f"circles among {sorted(left)}"


def test_benchmarks_use_public_names() -> None:
    """What a package lists in its `__all__`, and the zoo; kcgs knows nothing of benchmarks."""
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found = {alias.name for alias in node.names}
                assert not any(name.startswith(("kcgs.", "unittest")) for name in found), f"{path.name}: {found}"
            elif isinstance(node, ast.ImportFrom) and not node.level:
                source, found = node.module or "", {alias.name for alias in node.names}
                assert not source.startswith("unittest"), path.name
                if source.split(".")[0] == "kcgs" and source != "kcgs.zoo":
                    assert found <= {*import_module(source).__all__}, f"{path.name}: {source} {found}"
    assert not [name for name, path in modules().items() if re.search(r"(import|from) benchmarks", path.read_text())]


def test_private_names_of_maps_stay_below() -> None:
    """What a RegionMap keeps to itself is read in functional and kernels only."""
    for name, path in modules().items():
        if not name.startswith(("kcgs.functional", "kcgs.kernels")):
            assert not re.search(r"regions?\._[a-z]|membership\._[a-z]", path.read_text()), name


@pytest.mark.parametrize("word", GONE)
def test_words_that_are_gone(word: str) -> None:
    """One thing has one name; the key says which."""
    texts = [*PACKAGE.rglob("*.py"), ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("export/*.py")]
    found = []
    for path in texts:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if re.search(GONE[word], ALLOWED.sub("", line), re.IGNORECASE):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not found, f"say {word}:\n" + "\n".join(found)
