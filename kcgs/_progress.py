"""The progress bar of long work: on standard error, only on a terminal or in a notebook."""

from __future__ import annotations

from typing import Any


class Progress:
    """A progress bar while a `with` block runs.

    Args:
        name: of the work.
        pulse: the length of the work is not known: the bar pulses, and shows no share.
        visible: False: there is no bar.
    """

    def __init__(self, name: str, *, pulse: bool = False, visible: bool = True) -> None:
        self._name = name
        self._pulse = pulse
        self._visible = visible

    def __enter__(self) -> Progress:
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        visible = self._visible and (console.is_terminal or console.is_jupyter)
        note = progress.TextColumn("{task.fields[note]}")
        columns = progress.Progress.get_default_columns()
        self._bar: Any = progress.Progress(*columns, note, console=console, disable=not visible)
        self._task = self._bar.add_task(self._name, total=None if self._pulse else 1.0, note="")
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def update(self, share: float, note: str = "") -> None:
        """Show the share that is done, in [0, 1], and a note."""
        self._bar.update(self._task, completed=share, note=note)
