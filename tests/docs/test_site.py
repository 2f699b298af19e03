"""The site: it builds without a warning, its reference has every public name, the README stays a front page."""

from __future__ import annotations

import csv
import importlib
import importlib.util
import re
import subprocess
import sys
import zlib
from pathlib import Path
from statistics import fmean
from types import ModuleType

import pytest

import kcgs

ROOT = Path(kcgs.__file__).resolve().parent.parent
DOCS = ROOT / "docs"
README = ROOT / "README.md"
README_LINES = 125
if not (DOCS / "conf.py").is_file():
    pytest.skip("not a source checkout", allow_module_level=True)


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("kcgs_docs_generate", DOCS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it as `make docs` does, without copies of the code and buttons to copy it."""
    for package in ("sphinx", "myst_nb", "furo"):
        if importlib.util.find_spec(package) is None:
            pytest.skip("the site is built with the extra 'docs'")
    folder = tmp_path_factory.mktemp("site")
    options = ["-W", "--keep-going", "-q", "-D", "extensions=myst_nb,sphinx.ext.autodoc,sphinx.ext.napoleon"]
    command = [sys.executable, "-m", "sphinx", *options, "-d", str(folder / "doctrees")]
    build = subprocess.run([*command, str(DOCS), str(folder / "html")], capture_output=True, text=True, cwd=ROOT)
    assert build.returncode == 0, build.stdout + build.stderr
    return folder / "html"


def documented(site: Path) -> set[str]:
    """Return the full names in the site's inventory: after four lines of header, they begin its compressed lines."""
    content = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    return {line.split()[0] for line in zlib.decompress(content).decode().splitlines()}


def test_every_public_name_is_in_the_reference(site: Path, generate: ModuleType) -> None:
    names = documented(site)
    modules = {package: importlib.import_module(package) for package in generate.PACKAGES}
    for package, module in modules.items():
        for name in module.__all__:
            if name.startswith("__"):
                continue
            thing = getattr(module, name)
            same = {f"{p}.{name}" for p, m in modules.items() if getattr(m, name, None) is thing}
            assert same & names, f"{package}.{name}"


def test_every_page_has_commands_recipes_and_figures(site: Path, generate: ModuleType) -> None:
    """What is generated from the code is in the pages that include it."""
    from kcgs.fitting import FitConfig, available_recipes

    commands, recipes = ((site / f"{name}.html").read_text(encoding="utf-8") for name in ("command-line", "recipes"))
    names = "fit", "render", "eval", "segment", "info", "encode", "decode", "export", "view", "demo"
    for name in (*names, "fit-many", "fit-video"):
        assert f'id="kcgs-{name}"' in commands
    for name in (*FitConfig.model_fields, *available_recipes()):
        assert name in recipes


def test_readme_is_a_front_page() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= README_LINES
    for link in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / link).exists(), link


def test_readme_has_the_figures_of_the_results() -> None:
    """Its table is a part of the reports of quality and gpu-fit: mean PSNR and EF-PSNR on frames of DAVIS."""
    values: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for report in ("quality", "gpu-fit"):
        with (ROOT / f"benchmarks/reports/{report}/results.csv").open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                if row.get("group", "DAVIS") == "DAVIS" and row["ef_psnr"]:
                    values.setdefault((row["method"], int(row["n"])), []).append(
                        (float(row["psnr"]), float(row["ef_psnr"]))
                    )
    lines = [line.strip("|").split("|") for line in README.read_text(encoding="utf-8").splitlines() if "|" in line]
    counts = [int(cell.strip().removeprefix("N = ").replace(",", "")) for cell in lines[0][1:]]
    for title, *cells in lines[2:]:
        method = title.split("`")[1] + (", GPU" if "on a GPU" in title else "")
        for n, cell in zip(counts, cells, strict=True):
            if not cell.strip() and (method, n) not in values:
                continue
            psnr, ef_psnr = (fmean(column) for column in zip(*values[method, n], strict=True))
            assert cell.strip() == f"{psnr:.2f} / {ef_psnr:.2f}", (method, n)


def test_gallery_has_the_zoo(site: Path) -> None:
    from kcgs.zoo import entries

    gallery = (site / "gallery.html").read_text(encoding="utf-8")
    for entry in entries():
        assert f'<iframe src="gallery-{entry.name}.html"' in gallery
        assert "<kcgs-image " in (site / f"gallery-{entry.name}.html").read_text(encoding="utf-8")
