"""The clock of a fit."""

import time


class Clock:
    """Wall time of a fit, in seconds; a resumed fit starts at the seconds that it has already used."""

    def __init__(self, seconds: float = 0.0) -> None:
        self._started = time.perf_counter() - seconds

    def seconds(self) -> float:
        """Seconds that the fit has used."""
        return time.perf_counter() - self._started
