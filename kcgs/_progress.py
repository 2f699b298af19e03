"""What long work shows on standard error: a bar on a terminal or in a notebook, elsewhere a line every ten seconds."""

from __future__ import annotations

import html
import math
import sys
import threading
import time
from contextlib import suppress
from typing import Any

_LINE_SECONDS, _NOTEBOOK_SECONDS = 10.0, 0.2


class Progress:
    """One piece of work, shown while it lasts.

    Args:
        name: of the work.
        known: its length is known: `update` says what share is done. Otherwise only that it goes on is shown.
        shown: False: show nothing.
    """

    # of the next line: pieces of work that are short one by one, and follow each other, are long together
    _due = -math.inf

    def __init__(self, name: str, *, known: bool = True, shown: bool = True) -> None:
        self.name, self._known, self._shown = name, known, shown
        self._share, self._note = 0.0, ""
        self._start = self._updated = time.perf_counter()
        self._over = threading.Event()
        self._bar: Any = None
        self._handle: Any = None

    def __enter__(self) -> Progress:
        self._start = time.perf_counter()
        if not self._shown:
            return self
        if _in_notebook():
            from IPython.display import display

            self._handle = display(self._html(), raw=True, display_id=True)  # type: ignore[no-untyped-call]
            return self
        from rich.console import Console
        from rich.progress import Progress as Bar
        from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        console = Console(stderr=True)
        if console.is_terminal:
            ends = TextColumn("{task.fields[note]}"), TimeElapsedColumn(), TimeRemainingColumn()
            self._bar = Bar(SpinnerColumn(), *Bar.get_default_columns()[:3], *ends, console=console)
            self._bar.add_task(self.name, total=1.0 if self._known else None, note="")
            self._bar.start()
        else:
            if self._start > Progress._due + _LINE_SECONDS:
                Progress._due = self._start + _LINE_SECONDS
            # a thread: much of the work, such as compiling, calls nobody back
            threading.Thread(target=self._say_so_often, args=(sys.stderr,), daemon=True).start()
        return self

    @staticmethod
    def forget() -> None:
        """Have the next piece of work be the first: its first line is due ten seconds after it began."""
        Progress._due = -math.inf

    def __exit__(self, *error: object) -> None:
        self._over.set()
        if self._bar is not None:
            self._bar.stop()
        if self._handle is not None:
            self._handle.update(self._html(), raw=True)

    def update(self, share: float, note: str = "") -> None:
        """Say what share is done, and something about it."""
        self._share, self._note = min(max(share, self._share), 1.0), note
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self._share if self._known else None, note=note)
        elif self._handle is not None and time.perf_counter() - self._updated >= _NOTEBOOK_SECONDS:
            self._updated = time.perf_counter()
            self._handle.update(self._html(), raw=True)

    def text(self) -> str:
        """Describe the work in a line."""
        share = f"{self._share:.0%}".replace("%", " %") if self._known else ""
        return ", ".join(filter(None, (self.name, share, self._note, f"{time.perf_counter() - self._start:.0f} s")))

    def _html(self) -> dict[str, str]:
        value = f' value="{self._share:.3f}"' if self._known or self._over.is_set() else ""
        text = self.text()
        return {"text/html": f"<progress{value}></progress> {html.escape(text)}", "text/plain": text}

    def _say_so_often(self, stream: Any) -> None:
        while not self._over.wait(max(0.0, Progress._due - time.perf_counter())):
            Progress._due = time.perf_counter() + _LINE_SECONDS
            # a reader who has left, or a closed file, ends no work
            with suppress(OSError, ValueError):
                print(f"kcgs: {self.text()}", file=stream, flush=True)


def _in_notebook() -> bool:
    """Say whether there is a notebook's cell to show HTML in."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None
