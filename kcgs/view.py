"""A scene or a decoder in the browser: a page, served on this machine alone."""

from __future__ import annotations

import shutil
import sys
import tempfile
import webbrowser
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import quote, urlencode

from kcgs._shipped import shipped_folder
from kcgs.page.html import page_html, web_bytes
from kcgs.scene import Scene

_DECODER_PAGE = shipped_folder("web", checkout="export/web/dist")


class _Handler(SimpleHTTPRequestHandler):
    """Serves the page's files, and what was put beside them."""

    extensions_map: ClassVar[dict[str, str]] = {  # type: ignore[misc]
        **SimpleHTTPRequestHandler.extensions_map,
        ".mjs": "text/javascript",
        ".wasm": "application/wasm",
    }

    def __init__(self, *args: object, extra: Path, **kwargs: object) -> None:
        self.extra, self.shown = extra, {file.name for file in extra.iterdir()}
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def translate_path(self, path: str) -> str:
        if path.startswith("/scene/"):
            name = Path(path.partition("?")[0]).name
            return str(self.extra / name if name in self.shown else self.extra / "nothing")
        return super().translate_path(path)

    def send_head(self) -> Any:
        # other names for this machine are other people's
        if self.headers.get("Host", "").partition(":")[0] not in ("127.0.0.1", "localhost"):
            self.send_error(403, "only this machine's own address")
            return None
        return super().send_head()

    def list_directory(self, path: object) -> None:
        """List nothing."""
        self.send_error(404)

    def end_headers(self) -> None:
        # with these the page may use threads
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing of requests."""


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, address: Any) -> None:
        # a browser may leave at any moment
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, address)


def serve(
    scene: Scene | bytes,
    *,
    name: str = "scene",
    original: Path | None = None,
    contours: str = "scaled",
    port: int = 0,
    browser: bool = True,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the page of a scene, or of the bytes of a `.kcgs` file, on loopback until Ctrl-C.

    `name` is the scene's title on the page, `original` an image file to compare with, `contours` scaled or crisp; port
    0 is any that is free; `browser` opens a window, `say` takes the line that says where the page is.
    """
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        beside = None if original is None else f"scene/{_copy_original(original, folder)}"
        (folder / "scene.kcgs").write_bytes(web_bytes(scene))
        page = page_html("scene/scene.kcgs", title=name, contours=contours, original=beside)
        (folder / "index.html").write_text(page, encoding="utf-8")
        _serve(folder, folder, "", port=port, browser=browser, say=say)


def serve_decoder(
    decoder: Path,
    *,
    original: Path | None = None,
    port: int = 0,
    browser: bool = True,
    say: Callable[[str], object] = print,
    page: Path | None = None,
) -> None:
    """Serve the page that opens an ONNX decoder of a scene; see :func:`serve`.

    `page` is the folder of the built page; None: the package's own.
    """
    page = _DECODER_PAGE if page is None else page
    if not (page / "index.html").is_file():
        raise FileNotFoundError(
            f"the page for decoders is not built: there is no {page / 'index.html'}; install a wheel that holds it, or "
            "run `make page` in a checkout"
        )
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        shutil.copyfile(decoder, folder / "decoder.onnx")
        query = {"decoder": "scene/decoder.onnx", "name": decoder.stem}
        if original is not None:
            query["original"] = f"scene/{_copy_original(original, folder)}"
        address = f"?{urlencode(query, quote_via=quote, safe='/')}"
        _serve(page, folder, address, port=port, browser=browser, say=say)


def _copy_original(original: Path, folder: Path) -> str:
    if not original.is_file():
        raise FileNotFoundError(f"--original must be an image file; {original} is not there")
    name = f"original{original.suffix.lower()}"
    shutil.copyfile(original, folder / name)
    return name


def _serve(page: Path, extra: Path, address: str, *, port: int, browser: bool, say: Callable[[str], object]) -> None:
    with _Server(("127.0.0.1", port), partial(_Handler, directory=str(page), extra=extra)) as server:
        url = f"http://127.0.0.1:{server.server_address[1]}/{address}"
        say(f"{url} (Ctrl-C ends)")
        if browser:
            webbrowser.open(url)
        server.serve_forever()
