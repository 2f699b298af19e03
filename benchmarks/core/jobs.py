"""Work that takes long: many jobs here or on other processors, with a sign of how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
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
        done = run_jobs(partial(_attempt, function), jobs, engine=place.engine, workers=place.workers)
        for number, (index, error) in enumerate(done, 1):
            if error:
                failed.append(f"{jobs[index]}: {error}")
            progress.update(number / len(jobs), str(jobs[index]))
    return failed


def _attempt(function: Callable[[Job], object], job: Job) -> str:
    """Do a job and return its error, empty where there is none."""
    try:
        function(job)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


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
