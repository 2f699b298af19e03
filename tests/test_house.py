"""The shape of the code: layers, no circles, privacy."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import kcgs

PACKAGE = Path(kcgs.__file__).resolve().parent
ROOT = PACKAGE.parent
# a room imports itself and what is below it
LAYERS = [
    {"__main__"},
    {"cli"},
    {"page"},
    {"files", "video"},
    {"rate"},
    {"editing"},
    {"fitting", "codec", "onnx", "segment"},
    {"data", "evaluation", "pruning", "zoo"},
    {"storage"},
    {"scene"},
    {"optim"},
    {"nn"},
    {"functional"},
    {"kernels"},
    {"maps"},
    {"compiled", "engine", "plots"},
    {"_labels"},
    {"_image"},
    {"_atomic", "_check", "_decode", "_memory", "_objectives", "_progress", "_repr", "_sizes", "_suffixes", "_warn"},
    {"_arithmetic", "_names_0_3", "_numba_internals", "_rows", "_torch_internals", "errors"},
]
# modules beside the `__init__` of a package that others import, two of a package at most: they load numba or Triton
DOORS = {"kcgs.compiled.program", "kcgs.compiled.tasks", "kcgs.kernels.cuda.triton_function"}


class Import(NamedTuple):
    module: str
    name: str | None


def module_paths() -> dict[str, Path]:
    paths = sorted(PACKAGE.rglob("*.py"))
    return {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in paths}


MODULES = module_paths()


def imports(path: Path, package: list[str]) -> Iterator[Import]:
    """Yield every import of a file: at the top, in a function, or for its types."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (Import(alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                submodule = f"{source}.{alias.name}"
                yield Import(submodule, None) if submodule in MODULES else Import(source, alias.name)


@cache
def imports_of(module: str) -> list[Import]:
    parts = module.split(".")
    return [*imports(MODULES[module], parts if MODULES[module].name == "__init__.py" else parts[:-1])]


def graph() -> dict[str, set[str]]:
    """Return the modules of kcgs that each module imports, but for itself and its own package."""
    edges = {module: {entry.module for entry in imports_of(module)} & MODULES.keys() for module in MODULES}
    return {
        module: {t for t in targets if t != module and not module.startswith(f"{t}.")}
        for module, targets in edges.items()
    }


def test_imports_go_one_way() -> None:
    level = {room: height for height, rooms in enumerate(LAYERS) for room in rooms}
    for module, targets in graph().items():
        if module == "kcgs":
            continue
        room = module.split(".")[1]
        for target in targets:
            target_room = target.split(".")[1]
            assert target_room == room or level[target_room] > level[room], f"{module} imports {target}"


def test_only_a_scene_calls_what_is_above_it() -> None:
    """By the package, when it is saved or exported; the graph above has no edges to the package."""
    assert {module for module in MODULES if Import("kcgs", None) in imports_of(module)} == {"kcgs.scene"}


def test_no_circle_of_imports() -> None:
    edges = graph()
    while leaves := [module for module, targets in edges.items() if not targets & edges.keys()]:
        for module in leaves:
            del edges[module]
    assert not edges, f"circles among {sorted(edges)}"


def test_rooms_are_entered_through_their_doors() -> None:
    """Other rooms import a name that the `__init__` of a room imports, which imports no name in vain."""
    rooms = [module for module, path in MODULES.items() if module.count(".") == 1 and path.name == "__init__.py"]
    doors = {room: {entry.name for entry in imports_of(room) if entry.name} for room in rooms}
    used = {room: set(getattr(import_module(room), "__all__", ())) for room in rooms}
    for module in MODULES:
        for target, name in imports_of(module):
            room = ".".join(target.split(".")[:2])
            if room not in doors or f"{module}.".startswith(f"{room}.") or target in DOORS:
                continue
            path = f"{target}.{name}" if name else target
            if path != room:
                member = path.removeprefix(f"{room}.")
                assert member in doors[room], f"{module} imports {path}"
                used[room].add(member)
    assert not {room: names - used[room] for room, names in doors.items() if names - used[room]}


def test_no_room_is_imported_by_a_string() -> None:
    """Only `kcgs/__init__.py` does; others import modules of their own folder so."""
    for module, path in MODULES.items():
        for argument in re.findall(r"(?:import_module|__import__)\((.+?)[,)]", path.read_text()):
            assert module == "kcgs" or re.match(r'f"{__(name|package)__}\.', argument), f"{module}: {argument}"


def test_private_names_stay_in_their_package() -> None:
    """A name with an underscore is imported by no other file, a RegionMap's read in maps only."""
    for module, path in MODULES.items():
        private = [entry for entry in imports_of(module) if entry.name and re.match(r"_[a-z]", entry.name)]
        assert not private, f"{module}: {private}"
        if not module.startswith("kcgs.maps"):
            assert not re.search(r"regions?\._[a-z]|membership\._[a-z]", path.read_text()), module


def test_benchmarks_use_public_names() -> None:
    """They import what a package lists in its `__all__`; kcgs imports no benchmark."""
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        for module, name in imports(path, list(path.relative_to(ROOT).parent.parts)):
            assert not module.startswith("unittest"), f"{path.name} patches: {module}"
            package, public = (module, name) if name else module.rpartition(".")[::2]
            if package.startswith("kcgs."):
                assert public in import_module(package).__all__, f"{path.name} imports {package}.{public}"
    assert not [m for m in MODULES if any(entry.module.split(".")[0] == "benchmarks" for entry in imports_of(m))]
