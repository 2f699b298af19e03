"""How `make docs` builds the site: Sphinx, MyST, furo. Pages that the code can write are written by generate.py."""

import re
import shutil
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE)]

import generate  # noqa: E402

import kcgs  # noqa: E402
from kcgs.zoo import entries  # noqa: E402

project = "kcgs"
author = "the kcgs authors"
project_copyright = "the kcgs authors, Apache-2.0"
version = release = kcgs.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "sphinx_copybutton"]
exclude_patterns = ["_build", "generated/*.md"]
# "```python" blocks of our pages are run by tests/docs, with >>> or without
pygments_style = "friendly"
pygments_dark_style = "monokai"
html_theme = "furo"
html_title = "kcgs"
html_static_path = ["static"]
html_css_files = ["kcgs.css"]
html_extra_path = [f"generated/gallery-{entry.name}.{suffix}" for entry in entries() for suffix in ("html", "jpg")]
html_theme_options = {"navigation_with_keys": True}
html_copy_source = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_merge_streams = True

default_role = "code"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Convention", "notes_style"), ("Source", "notes_style")]

attributes: dict[str, list[str]] = {}


def copy_pages() -> None:
    """Put the tutorials and the reports where Sphinx looks for pages; a file that is the same keeps its date."""
    for name in ("notebooks", "benchmarks/reports"):
        folder, source = HERE / name, ROOT / name
        originals = {path.relative_to(source) for path in source.rglob("*") if path.is_file()}
        pages = {path for path in originals if path.suffix in (".ipynb", ".md", ".png", ".jpg", ".csv")}
        for stale in {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} - pages:
            (folder / stale).unlink()
        for path in pages:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source / path, folder / path)


def mark_paragraphs(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Set the word before a docstring's conventions and source in bold; drop what Python itself writes of fields."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()
    for i, line in enumerate(lines):
        for word in ("Convention", "Source"):
            if line.startswith(f"{word}: "):
                lines[i] = f"**{word}.** {line.removeprefix(f'{word}: ')}"


def save_colons(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Keep what is said of an attribute from napoleon, which takes all before a colon for its type."""
    if what == "attribute":
        attributes[name] = lines[:]
        lines.clear()


def restore_colons(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Put it back after napoleon."""
    lines[:] = attributes.pop(name, lines)


def hide_private(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returned: str | None
) -> tuple[str, str | None] | None:
    """Leave out the arguments of a class that is not built by hand: some of them are private."""
    return ("", returned) if what == "class" and signature and re.search(r"\b_[a-z]", signature) else None


def link_repository(app: Sphinx, docname: str, source: list[str]) -> None:
    """Let links that work where the repository is read lead to the copies that the site has."""
    source[0] = re.sub(r"\]\(\.\./(notebooks|benchmarks)/", r"](\1/", source[0])


def visit_inline_math(self: HTML5Translator, node: nodes.math) -> None:
    """Write a formula as MathML, which browsers set without scripts or fonts from elsewhere."""
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def visit_block_math(self: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula of its own paragraph as MathML."""
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Write the generated pages, and tell Sphinx of the functions above."""
    generate.write(HERE / "generated")
    copy_pages()
    app.add_html_math_renderer("mathml", (visit_inline_math, None), (visit_block_math, None))
    app.connect("autodoc-process-docstring", save_colons, priority=400)  # napoleon has 500
    app.connect("autodoc-process-docstring", restore_colons, priority=600)
    app.connect("autodoc-process-docstring", mark_paragraphs, priority=700)
    app.connect("autodoc-process-signature", hide_private)
    app.connect("source-read", link_repository)


html_math_renderer = "mathml"
