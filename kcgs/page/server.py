"""A page in the browser, served on this machine alone."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


def serve(page: str, *, port: int = 0, browser: bool = True, say: Callable[[str], object] = print) -> None:
    """Serve a page on loopback until Ctrl-C.

    `port` 0 is any free port; `browser` opens a window; `say` takes the line with the page's address.
    """
    content = page.encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # a site whose name resolves to this machine must not read the scene
            if self.headers.get("Host", "").partition(":")[0] not in ("127.0.0.1", "localhost"):
                return self.send_error(403, "only this machine's own address")
            if self.path != "/":
                return self.send_error(404)
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            # a browser may leave at any moment
            with suppress(ConnectionError):
                self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            """Log no requests."""

    with ThreadingHTTPServer(("127.0.0.1", port), Handler) as server:
        url = f"http://127.0.0.1:{server.server_address[1]}/"
        say(f"{url} (Ctrl-C ends)")
        if browser:
            webbrowser.open(url)
        server.serve_forever()
