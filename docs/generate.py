"""Pages that the code itself can write: the reference, commands, recipes, the gallery. conf.py calls `write`."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import shutil
import typing
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import Any

from kcgs import load
from kcgs.page import scene_page
from kcgs.zoo import entries, find

# What readers look for first heads its page; other modules follow in the order in which the package imports them.
FIRST = ("kcgs.scene", "kcgs.functional.splat", "kcgs.maps.regions", "kcgs.segment.registry")
# The scene that the front page shows first.
FRONT = "coffee-1500"
# What torch and pydantic call, not readers.
PROTOCOL = "extra_repr, get_extra_state, set_extra_state, model_config, model_post_init"
# Each public name is documented in the first of these packages that lists it in its `__all__`.
PACKAGES = (
    "kcgs",
    "kcgs.functional",
    "kcgs.nn",
    "kcgs.optim",
    "kcgs.editing",
    "kcgs.fitting",
    "kcgs.video",
    "kcgs.rate",
    "kcgs.codec",
    "kcgs.segment",
    "kcgs.onnx",
    "kcgs.page",
    "kcgs.data",
    "kcgs.engine",
)
PACKAGES = tuple(name for name in PACKAGES if importlib.util.find_spec(name))


def write(folder: Path) -> None:
    """Write all generated pages; a file whose text is as before keeps its date, so that Sphinx does not read it again.

    Args:
        folder: where they go; made where it is missing.
    """
    pages = {"commands.md": commands(), "recipes.md": recipes(), "segmenters.md": segmenters()}
    documented: dict[str, str] = {}
    for name in PACKAGES:
        pages[f"{name}.rst"] = reference(name, documented)
    pages |= gallery()
    previews = {f"gallery-{entry.name}.jpg": find(entry.name).with_name("preview.jpg") for entry in entries()}
    folder.mkdir(exist_ok=True)
    for stale in {path.name for path in folder.iterdir()} - pages.keys() - previews.keys():
        (folder / stale).unlink()
    for name, path in previews.items():
        shutil.copy2(path, folder / name)
    for name, text in pages.items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def public_objects(package: str) -> dict[str, Any]:
    """Return what a package lists in `__all__`, by name, in the order of its imports, less its version."""
    module = importlib.import_module(package)
    public = {name for name in module.__all__ if not name.startswith("__")}
    # the top package imports a name when it is used
    return {name: getattr(module, name) for name in (*vars(module), *module.__all__) if name in public}


def identity(name: str, thing: Any) -> str:
    """Return the same string for the same thing under two public paths."""
    home = getattr(thing, "__module__", None)
    return f"{home}.{thing.__qualname__}" if home and hasattr(thing, "__qualname__") else f"{name} {id(thing)}"


def reference(package: str, documented: dict[str, str]) -> str:
    """Return the reference page of a package: its names by the module that holds them, in that module's order.

    Args:
        package: its full name.
        documented: full names of the things that earlier pages have, by identity; those of this page are added.
    """
    module = importlib.import_module(package)
    parts = [_title(package, "="), _summary(module), f".. py:currentmodule:: {package}"]
    groups: dict[str, list[str]] = {}
    elsewhere: list[str] = []
    for name, thing in public_objects(package).items():
        if identity(name, thing) in documented:
            elsewhere.append(f":py:obj:`~{documented[identity(name, thing)]}`")
            continue
        documented[identity(name, thing)] = f"{package}.{name}"
        groups.setdefault(getattr(thing, "__module__", package), []).append(name)
    if elsewhere:
        parts.append(f"Also in this package, and described under the shorter path: {', '.join(sorted(elsewhere))}.")
    ahead = [home for home in FIRST if home in groups]
    for home in ahead + [home for home in groups if home not in ahead]:
        if len(groups) > 1 and package != "kcgs" and home != package:
            parts.append(_title(_heading(importlib.import_module(home)), "-"))
        parts += [_directive(package, name, getattr(module, name)) for name in sorted(groups[home], key=_line(module))]
    return "\n\n".join(parts) + "\n"


def _title(text: str, underline: str) -> str:
    return f"{text}\n{underline * len(text)}"


def _summary(module: ModuleType) -> str:
    return inspect.cleandoc(module.__doc__ or "")


def _heading(module: ModuleType) -> str:
    """Return the first sentence of a module's docstring, up to a colon, as a heading."""
    return _summary(module).split("\n\n")[0].replace("\n", " ").partition(":")[0].rstrip(".").replace("`", "")


def _line(module: ModuleType) -> Any:
    """Return a key that sorts names by where they are defined."""

    def key(name: str) -> int:
        try:
            return inspect.getsourcelines(getattr(module, name))[1]
        except (OSError, TypeError):
            return 0

    return key


def _directive(package: str, name: str, thing: Any) -> str:
    if inspect.isclass(thing):
        return f".. autoclass:: {package}.{name}\n   :members:\n   :exclude-members: {PROTOCOL}"
    if callable(thing):
        return f".. autofunction:: {package}.{name}"
    # a path is that of the machine that builds the site
    return f".. autodata:: {package}.{name}" + ("\n   :no-value:" if isinstance(thing, Path) else "")


def commands() -> str:
    """Return the commands with their arguments and options, as `kcgs COMMAND --help` says them."""
    import typer

    from kcgs.cli import app

    group: Any = typer.main.get_command(app)
    return "\n\n".join(_command(name, command) for name, command in sorted(group.commands.items())) + "\n"


def _command(name: str, command: Any) -> str:
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(["kcgs", name, *command.collect_usage_pieces(context)])
    # arguments first, each of them as it is written and what it is
    params = sorted(command.params, key=lambda param: param.param_type_name != "argument")
    records = [param.get_help_record(context) for param in params]
    rows = [f"| `{_plain(written)}` | {_cell(text)} |" for written, text in filter(None, records)]
    table = "\n".join(["| argument | what it is |", "|---|---|", *rows]) if rows else ""
    text = _mark_options(inspect.cleandoc(command.help or ""))
    return "\n\n".join([f"## kcgs {name}", f"```text\n{usage}\n```", text, table])


def _plain(text: str) -> str:
    """Return text for a cell of a Markdown table, on one line and with numbers called as readers know them."""
    text = " ".join(text.split()).replace("<int range>", "<int>").replace("<float range>", "<float>")
    return text.replace("|", "\\|")


def _cell(text: str) -> str:
    """Return the same with the options that it mentions set as code."""
    return _mark_options(_plain(text))


def _mark_options(text: str) -> str:
    return re.sub(r"(?<![\w`-])--[a-z][a-z-]+", r"`\g<0>`", text)


def gallery() -> dict[str, str]:
    """Return a page for each scene of the zoo, and the HTML of the gallery and of the front page, by file name."""
    pages, frames, thumbnails = {}, [], []
    for entry in sorted(entries(), key=lambda entry: entry.name.startswith("chart")):
        scene, name = load(find(entry.name)), f"gallery-{entry.name}.html"
        height, width = scene.size
        pages[name] = scene_page(scene, title=entry.title)
        shape = f"aspect-ratio: {width} / {height + width // 10}"  # a tenth of the width for the buttons
        subject = entry.title.partition(",")[0].capitalize()  # the page has the numbers
        frames.append(
            f'<iframe src="{name}" title="{entry.title}" loading="lazy" style="{shape}">'
            f'</iframe>\n<p>{subject}: {entry.licence}. <a href="{name}">In a window</a></p>'
        )
        preview = f'<img src="gallery-{entry.name}.jpg" alt="{entry.title}" title="{entry.title}">'
        thumbnails.append(f'<a href="{name}" target="scene">{preview}</a>')
    pages["gallery.md"] = "\n\n".join(frames) + "\n"
    # a click on a preview opens its page in the frame
    first = f'<iframe name="scene" src="gallery-{FRONT}.html" title="A scene" style="aspect-ratio: 4 / 3"></iframe>'
    pages["front.md"] = "\n".join([first, '<div class="previews">', *thumbnails, "</div>"]) + "\n"
    return pages


def segmenters() -> str:
    """Return a table of the methods of `kcgs.segment`: the first sentence of each, and its own options."""
    from kcgs.segment import Cleanup, available_methods, method_options
    from kcgs.segment.registry import _methods

    shared = inspect.signature(Cleanup).parameters
    rows = ["| method | how | its options |", "|---|---|---|"]
    for name in available_methods():
        options = [f"`{key}`" for key in method_options(name) if key not in shared]
        sentence = inspect.cleandoc(_methods[name].function.__doc__ or "").split("\n\n")[0]
        sentence = re.sub(r":func:`([^`]+)`", r"`\1`", sentence)
        rows.append(f"| `{name}` | {_cell(sentence)} | {', '.join(options)} |")
    return "\n".join(rows) + "\n"


def recipes() -> str:
    """Return what each recipe is, the settings of a fit with their defaults, and the recipes as they are on disk."""
    from kcgs.fitting import FitConfig, available_recipes

    table, blocks = ["| recipe | what it is |", "|---|---|"], []
    for name in available_recipes():
        lines = (files("kcgs.recipes") / f"{name}.toml").read_text(encoding="utf-8").splitlines()
        comment = " ".join(line.lstrip("# ") for line in lines if line.startswith("#"))
        table.append(f"| [`{name}`](#{name}) | {_cell(comment)} |")
        settings = [line for line in lines if line and not line.startswith("#")]
        blocks += [f"### {name}", "```toml\n" + "\n".join(settings) + "\n```" if settings else "The defaults."]
    rows = ["| setting | type | default | what it is |", "|---|---|---|---|"]
    for name, field in FitConfig.model_fields.items():
        text = _cell(field.description or "")
        rows.append(f"| `{name}` | {_type(field.annotation)} | `{field.default!r}` | {text} |")
    parts = ["\n".join(table), "## Settings", "\n".join(rows), "## The files", *blocks]
    return "\n\n".join(parts) + "\n"


def _type(annotation: Any) -> str:
    """Return a type as readers of settings know it: `float`, `"auto"`, one of several with "or" between."""
    if typing.get_origin(annotation) is typing.Literal:
        return " or ".join(f"`{value!r}`" for value in typing.get_args(annotation))
    if typing.get_origin(annotation) is Callable:
        return "a function"
    alternatives = [part for part in typing.get_args(annotation) if part is not type(None)]
    if alternatives and typing.get_origin(annotation) is not tuple:
        return " or ".join(map(_type, alternatives))
    return f"`{getattr(annotation, '__name__', annotation)}`"
