"""What tests of the web need: a browser, and the packages that pages are built with."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from .browser import WEB, Browser, compile_decoder, npm


@pytest.fixture(scope="session")
def chromium() -> str:
    for program in ("node", "npm", "chromium"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    return str(shutil.which("chromium"))


@pytest.fixture(scope="session")
def browser(chromium: str, node_modules: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for the tests of all files."""
    browser = Browser(chromium, tmp_path_factory.mktemp("browser") / "errors.txt")
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def node_modules(chromium: str) -> Path:
    """Packages of the lock file, installed into export/web where they are missing or older than it."""
    lock, installed = WEB / "package-lock.json", WEB / "node_modules" / ".package-lock.json"
    if not lock.exists():
        pytest.skip("the sources of the page are not here")
    if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
        result = npm("ci", "--no-audit", "--no-fund")
        if result.returncode != 0:
            pytest.skip(f"npm ci failed, so the page cannot be built: {result.stderr.strip()[-500:]}")
    compile_decoder()
    return installed.parent
