"""What long work shows: a bar on standard error, only on a terminal or in a notebook."""

from __future__ import annotations

from typing import Any


class Progress:
    """One piece of work, shown while it lasts.

    Args:
        name: of the work.
        known: its length is known: `update` says what share is done. Otherwise only that it goes on is shown.
        shown: False: show nothing.
    """

    def __init__(self, name: str, *, known: bool = True, shown: bool = True) -> None:
        self._name, self._known, self._shown = name, known, shown

    def __enter__(self) -> Progress:
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        is_seen = self._shown and (console.is_terminal or console.is_jupyter)
        note = progress.TextColumn("{task.fields[note]}")
        columns = progress.Progress.get_default_columns()
        self._bar: Any = progress.Progress(*columns, note, console=console, disable=not is_seen)
        self._task = self._bar.add_task(self._name, total=1.0 if self._known else None, note="")
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def update(self, share: float, note: str = "") -> None:
        """Show what share is done, and a note about it."""
        self._bar.update(self._task, completed=share, note=note)
