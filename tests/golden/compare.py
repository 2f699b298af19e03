"""Compare a commit with this tree: the bits of the golden cases, and the time of fits, files and renders.

    python -m tests.golden.compare COMMIT                        the bits of all cases, and the time of renders
    python -m tests.golden.compare COMMIT --data DIR             the time of fits and files, too
    python -m tests.golden.compare COMMIT --only fit/ time/W1    only of cases whose names start so

Each tree runs its own golden cases, so bits are those of the processor at hand, and an adapter may have changed. Bits
that differ are only named, since they may do so on purpose. The exit status is 1 where a ratio of times, the median of
turns, is above 1.05. The column `cores` has that of the seconds of all cores together: other processes change it less.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
WORKER = Path(__file__).with_name("worker.py")
LARGEST_RATIO = 1.05


def git(*arguments: str | Path) -> None:
    """Run git in this tree; a ValueError has its message."""
    done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"git {arguments[0]} failed: {done.stderr.strip()}")


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary worktree."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder).resolve() / "tree"
        git("worktree", "add", "--detach", tree, commit)
        try:
            if not (tree / "tests/golden/record.py").exists():
                raise ValueError(f"commit must have the golden cases of tests/golden; {commit} has none")
            yield tree
        finally:
            git("worktree", "remove", "--force", tree)


class Worker:
    """A process that runs the cases of a tree; see worker.py."""

    def __init__(self, tree: Path, threads: int | None = None) -> None:
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        if threads is not None:
            environment["OMP_NUM_THREADS"] = str(threads)
        self._tree = tree
        self._process = subprocess.Popen(
            [sys.executable, "-P", WORKER],
            cwd=tree,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # Ctrl-C reaches only this process, which ends its workers
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        with self._process as process:
            process.kill()

    def send(self, *request: Any) -> None:
        assert self._process.stdin is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)

    def receive(self) -> Any:
        assert self._process.stdout is not None
        if line := self._process.stdout.readline():
            return json.loads(line)
        raise ChildProcessError(f"a case failed in {self._tree}; its traceback is above")

    def ask(self, *request: Any) -> Any:
        self.send(*request)
        return self.receive()


def compare_bits(old: Worker, new: Worker, prefixes: tuple[str, ...]) -> None:
    """Print which values differ; both trees compute at the same time."""
    old_names, new_names = (
        [name for name in worker.ask("golden cases") if name.startswith(prefixes)] for worker in (old, new)
    )
    names = [name for name in new_names if name in old_names]
    num_same = 0
    for name in names:
        for worker in (old, new):
            worker.send("digests", name)
        a, b = old.receive(), new.receive()
        changed = sorted(key for key in a | b if a.get(key) != b.get(key))
        num_same += not changed
        if changed:
            print(f"{name}: {', '.join(changed)}", flush=True)
    for place, others in {"commit": set(old_names) - set(names), "tree": set(new_names) - set(names)}.items():
        if others:
            print(f"only in the {place}: {', '.join(sorted(others))}")
    print(f"{num_same} of {len(names)} cases are the same", flush=True)


def compare_times(old: Worker, new: Worker, prefixes: tuple[str, ...], data: str | None, repeats: int) -> float:
    """Print times and qualities, and return the largest ratio; the trees take turns after a first call of each."""
    largest = 0.0
    cases = {name: needs_data for name, needs_data in new.ask("timed cases").items() if name.startswith(prefixes)}
    if cases:
        print(f"{'case':24} {'old, s':>8} {'new, s':>8} {'ratio':>6} {'min-max':9} {'cores':>6}  {'old':16} new")
    for name, needs_data in cases.items():
        if needs_data and data is None:
            print(f"{name:24} skipped: it needs --data")
            continue
        turns = [[worker.ask("time", name, data) for worker in (old, new)] for _ in range(repeats + 1)][1:]
        old_seconds, new_seconds = (median(turn[i][0] for turn in turns) for i in (0, 1))
        ratios, cpu_ratios = ([b[k] / a[k] for a, b in turns] for k in (0, 1))
        old_quality, new_quality = (result[2] for result in turns[0])
        print(
            f"{name:24} {old_seconds:8.4f} {new_seconds:8.4f} {median(ratios):6.3f} "
            f"{min(ratios):.2f}-{max(ratios):.2f} {median(cpu_ratios):6.3f}  {old_quality:16} {new_quality}",
            flush=True,
        )
        largest = max(largest, median(ratios))
    return largest


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = argparse.ArgumentParser("python -m tests.golden.compare", description="Compare a commit with this tree.")
    parser.add_argument("commit")
    parser.add_argument("--data", help="folder with DAVIS and kodak in it")
    parser.add_argument("--repeats", type=int, default=5, help="turns of each timed case; 0: bits alone")
    parser.add_argument("--threads", type=int, help="of timed cases; default: torch's")
    parser.add_argument("--only", nargs="+", default=[""], metavar="NAME", help="beginnings of names of cases")
    options = parser.parse_args(arguments)
    data = None if options.data is None else os.path.abspath(options.data)
    prefixes = tuple(options.only)
    try:
        with (
            checkout(options.commit) as tree,
            Worker(tree, options.threads) as old,
            Worker(ROOT, options.threads) as new,
        ):
            compare_bits(old, new, prefixes)
            if not options.repeats:
                return 0
            return int(compare_times(old, new, prefixes, data, options.repeats) > LARGEST_RATIO)
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `timeout` leaves no worktree behind
    sys.exit(main())
