"""A scene in the browser: its decoder and the viewer's page, served on this machine alone."""

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
from kcgs.onnx import scene_decoder, write_model
from kcgs.scene import Scene

_PAGE = shipped_folder("web", checkout="export/web/dist")


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
    scene: Scene,
    *,
    name: str = "scene",
    original: Path | None = None,
    contours: str = "scaled",
    port: int = 0,
    browser: bool = True,
    say: Callable[[str], object] = print,
    page: Path | None = None,
) -> None:
    """Export a scene to a temporary folder and serve the viewer on loopback until Ctrl-C.

    `name` is the scene's title on the page, `original` an image file to compare with, `contours` scaled or crisp; port
    0 is any that is free; `browser` opens a window, `say` takes the line that says where the page is. `page` is the
    folder of the built page; None: the package's own.
    """
    page = _PAGE if page is None else page
    if not (page / "index.html").is_file():
        raise FileNotFoundError(
            f"the viewer's page is not built: there is no {page / 'index.html'}; install a wheel that holds it, or run "
            "`make page` in a checkout"
        )
    if original is not None and not original.is_file():
        raise FileNotFoundError(f"--original must be an image file; {original} is not there")
    with tempfile.TemporaryDirectory() as folder:
        model = scene_decoder(scene, interactive=True, contours=contours)
        write_model(model, Path(folder) / "decoder.onnx")
        query = {"decoder": "scene/decoder.onnx", "name": name}
        if original is not None:
            shutil.copyfile(original, Path(folder) / f"original{original.suffix.lower()}")
            query["original"] = f"scene/original{original.suffix.lower()}"
        handler = partial(_Handler, directory=str(page), extra=Path(folder))
        with _Server(("127.0.0.1", port), handler) as server:
            url = f"http://127.0.0.1:{server.server_address[1]}/?{urlencode(query, quote_via=quote, safe='/')}"
            say(f"{url} (Ctrl-C ends)")
            if browser:
                webbrowser.open(url)
            server.serve_forever()
