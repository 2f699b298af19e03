"""Work that takes long: many jobs here or on other processors, with a sign of how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

from kcgs._progress import Progress
from kcgs.engine import run_jobs

Job = TypeVar("Job")


class Place(NamedTuple):
    """Where fits are made: the options --engine and --workers. A fit has one thread: all places give the same."""

    engine: str = "local"
    workers: int | None = None

    @property
    def is_local(self) -> bool:
        """Whether fits run one after another in this process."""
        return self.engine == "local" and self.workers in (None, 1)

    def __str__(self) -> str:
        if self.is_local:
            return "one at a time on one thread"
        count = "as many as there are processors for" if self.workers is None else f"{self.workers}"
        return f"{count} at a time on one thread each, engine {self.engine}"


def make_all(function: Callable[[Job], object], jobs: Sequence[Job], place: Place) -> list[str]:
    """Do jobs that keep what they make on disk themselves; return what failed, one line each."""
    failed: list[str] = []
    with Progress("bench") as progress:
        for number, ended in enumerate(run_jobs(function, jobs, engine=place.engine, workers=place.workers), 1):
            if ended.error is not None:
                failed.append(f"{jobs[ended.index]}: {ended.error}")
            # in this process the next job is the one that runs
            shown = min(number, len(jobs) - 1) if place.is_local else ended.index
            progress.update(number / len(jobs), str(jobs[shown]))
    return failed


def check_made(failed: Sequence[str]) -> None:
    """Raise a RuntimeError that names all jobs that failed, once all that could be done is done."""
    if failed:
        raise RuntimeError(f"fits failed, {len(failed)} of them: {'; '.join(failed)}")


def with_progress(steps: Sequence[tuple[str, Job]]) -> Iterator[Job]:
    """Yield the second of each pair, with the first beside a bar."""
    with Progress("bench") as progress:
        for number, (name, step) in enumerate(steps):
            progress.update(number / len(steps), name)
            yield step
