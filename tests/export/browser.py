"""Headless Chromium for tests, a server for its pages, and npm."""

from __future__ import annotations

import base64
import functools
import http.server
import json
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WEB = Path(__file__).resolve().parents[2] / "export" / "web"


class Pipe:
    """A program of node that answers a line of JSON with another."""

    def __init__(self, *arguments: str, errors: Path) -> None:
        self.errors = errors
        self._log = errors.open("w")
        self._process = subprocess.Popen(
            ["node", *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True
        )

    def ask(self, action: str, **arguments: Any) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps({"do": action, **arguments}) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, f"the program ended: {self.errors.read_text()[-2000:]}"
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._log.close()


class Browser(Pipe):
    """Headless Chromium; see export/web/test/drive.mjs."""

    def __init__(self, chromium: str, errors: Path) -> None:
        super().__init__(str(WEB / "test" / "drive.mjs"), chromium, errors=errors)

    def do(self, action: str, **arguments: Any) -> Any:
        answer = self.ask(action, **arguments)
        assert "error" not in answer, answer["error"]
        return answer["value"]

    def evaluate(self, expression: str) -> Any:
        return self.do("evaluate", expression=expression)


def array(packed: dict[str, Any]) -> NDArray[np.float32]:
    data = np.frombuffer(base64.b64decode(packed["data"]["float32"]), dtype=np.float32)
    return data.reshape(packed["dims"])


class Handler(http.server.SimpleHTTPRequestHandler):
    """A plain static server; below /slow/ the second half of a file waits for `release`."""

    release = threading.Event()

    def translate_path(self, path: str) -> str:
        return super().translate_path(path.removeprefix("/slow"))

    def copyfile(self, source: Any, outputfile: Any) -> None:
        data = source.read()
        half = len(data) // 2 if self.path.startswith("/slow/") else len(data)
        outputfile.write(data[:half])
        outputfile.flush()
        if half < len(data):
            self.release.wait()
            outputfile.write(data[half:])

    def end_headers(self) -> None:
        # a test may rewrite a file within the second that dates count in: what was read before must not come again
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """Serve a folder; give its address."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


def npm(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["npm", *arguments], cwd=WEB, capture_output=True, text=True)


def check_npm(*arguments: str) -> str:
    """Run npm; return what it prints."""
    result = npm(*arguments)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def build(script: str, *arguments: str) -> None:
    """Run a script that builds, without the scripts before and after it: the decoder is there."""
    check_npm("run", "--ignore-scripts", script, *arguments)


def compile_decoder() -> None:
    """Make the decoder's WebAssembly, where it is missing or older than its sources."""
    program, sources = WEB / "decoder" / "program.wasm", (WEB / "decoder" / "assembly").glob("*.ts")
    if not program.exists() or program.stat().st_mtime < max(source.stat().st_mtime for source in sources):
        check_npm("run", "wasm")
