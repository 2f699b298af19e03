"""A commit is compared with a tree."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from . import compare

pytestmark = pytest.mark.skipif(
    not (compare.ROOT / ".git").exists() or shutil.which("git") is None,
    reason="commits are compared in the repository, by git",
)
EDIT = """
metrics = CASES["functional/metrics"]
CASES["functional/metrics"] = lambda: {**metrics(), "psnr": 0.0}
CASES["functional/new"] = metrics
"""


def is_left(tree) -> bool:
    command = ["git", "-C", compare.ROOT, "worktree", "list", "--porcelain"]
    return tree.exists() or str(tree) in subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_cases_and_values_that_differ_are_named(monkeypatch, capsys) -> None:
    with compare.checkout("HEAD") as tree:
        with (tree / "tests/golden/cases.py").open("a") as cases:
            cases.write(EDIT)
        monkeypatch.setattr(compare, "ROOT", tree)
        assert compare.main(["HEAD", "--only", "functional/metrics", "functional/new", "splat/tiled-batch"]) == 0
        monkeypatch.undo()
    printed = capsys.readouterr().out.splitlines()
    assert printed == ["functional/metrics: psnr", "only in the tree: functional/new", "1 of 2 cases are the same"]


def test_no_worktree_is_left() -> None:
    with pytest.raises(KeyboardInterrupt), compare.checkout("HEAD") as tree:
        assert is_left(tree)
        raise KeyboardInterrupt
    assert not is_left(tree)


def test_unknown_commit(capsys) -> None:
    with pytest.raises(SystemExit):
        compare.main(["no-such-commit"])
    assert "no-such-commit" in capsys.readouterr().err
