"""What tests of the web need: a browser, and the packages that pages are built with."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from .browser import WEB, compile_decoder, npm
from .decoding import Node


@pytest.fixture(scope="session")
def chromium() -> str:
    for program in ("node", "npm", "chromium"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    return str(shutil.which("chromium"))


@pytest.fixture(scope="session")
def node_modules(chromium: str) -> Path:
    """Packages of the lock file, installed into export/web where they are missing or older than it."""
    lock, installed = WEB / "package-lock.json", WEB / "node_modules" / ".package-lock.json"
    if not lock.exists():
        pytest.skip("the sources of the page are not here")
    if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
        done = npm("ci", "--no-audit", "--no-fund")
        if done.returncode != 0:
            pytest.skip(f"npm ci failed, so the page cannot be built: {done.stderr.strip()[-500:]}")
    compile_decoder()
    return installed.parent


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The decoder, built as `npm run build` builds it."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    if not (WEB / "node_modules" / "vite").exists():
        pytest.skip("export/web has no node_modules, with which its decoder is built: npm --prefix export/web ci")
    compile_decoder()
    folder = tmp_path_factory.mktemp("decoder")
    done = npm("exec", "--", "vite", "build", "--config", "decoder/vite.config.ts", "--outDir", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="session")
def node(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    running = Node(bundle, tmp_path_factory.mktemp("node"))
    yield running
    running.close()
