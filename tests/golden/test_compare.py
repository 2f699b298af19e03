"""A commit is compared with a tree."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys

import pytest

from . import compare, record, worker

pytestmark = pytest.mark.skipif(
    not (compare.ROOT / ".git").exists() or shutil.which("git") is None,
    reason="commits are compared in the repository, by git",
)


class Answers:
    """A worker whose cases have these digests."""

    def __init__(self, digests: dict[str, dict[str, str]]) -> None:
        self.digests = digests

    def ask(self, request: str) -> list[str]:
        assert request == "golden cases"
        return [*self.digests]

    def send(self, request: str, name: str) -> None:
        assert request == "digests"
        self.name = name

    def receive(self) -> dict[str, str]:
        return self.digests[self.name]


def is_left(tree) -> bool:
    command = ["git", "-C", compare.ROOT, "worktree", "list", "--porcelain"]
    return tree.exists() or str(tree) in subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_cases_and_values_that_differ_are_named(capsys) -> None:
    old = Answers({"a/same": {"x": "1"}, "a/psnr": {"x": "1", "psnr": "2"}, "a/old": {}, "b/other": {}})
    new = Answers({"a/same": {"x": "1"}, "a/psnr": {"x": "1", "psnr": "3"}, "a/new": {}, "b/other": {"x": "1"}})
    compare.compare_bits(old, new, ("a/",))
    printed = capsys.readouterr().out.splitlines()
    assert printed == [
        "a/psnr: psnr", "only in the commit: a/old", "only in the tree: a/new", "1 of 2 cases are the same",
    ]  # fmt: skip


def test_a_worker_answers(monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO('["golden cases"]\n["digests", "splat/tiled-batch"]\n'))
    monkeypatch.setattr("sys.stdout", sys.stdout)  # which the worker changes
    worker.main()
    names, digests = map(json.loads, capsys.readouterr().out.splitlines())
    assert names == [*record.CASES] and digests == record.compute("splat/tiled-batch")


def test_a_process_is_asked(monkeypatch, tmp_path) -> None:
    (tmp_path / "worker.py").write_text("import sys\nfor line in sys.stdin: print(line, end='', flush=True)")
    monkeypatch.setattr(compare, "WORKER", tmp_path / "worker.py")
    with compare.Worker(tmp_path) as process:
        assert process.ask("digests", "a") == ["digests", "a"]


def test_no_worktree_is_left() -> None:
    with pytest.raises(KeyboardInterrupt), compare.checkout("HEAD") as tree:
        assert is_left(tree)
        raise KeyboardInterrupt
    assert not is_left(tree)


def test_unknown_commit(capsys) -> None:
    with pytest.raises(SystemExit):
        compare.main(["no-such-commit"])
    assert "no-such-commit" in capsys.readouterr().err
