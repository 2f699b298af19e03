"""Whole files or none."""

import stat
from pathlib import Path

import pytest

from kcgs._atomic import atomic_path


def test_the_file_appears_at_the_end(tmp_path: Path) -> None:
    (tmp_path / "scene.tar.png").write_bytes(b"old")
    with atomic_path(str(tmp_path / "scene.tar.png")) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".png" and not temporary.exists()
        temporary.write_bytes(b"new")
        assert (tmp_path / "scene.tar.png").read_bytes() == b"old"
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("scene.tar.png", b"new")]


def test_two_writers_do_not_share_a_temporary(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as first, atomic_path(tmp_path / "a") as second:
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "a").read_text() == "first"


@pytest.mark.parametrize(("error", "written"), [(KeyboardInterrupt, True), (RuntimeError, False)])
def test_any_exception_keeps_the_old_file(tmp_path: Path, error: type[BaseException], written: bool) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(error), atomic_path(target) as temporary:
        if written:
            temporary.write_text("half")
        raise error
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"] and target.read_text() == "old"


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [(".", IsADirectoryError, "is a folder"), ("a", FileNotFoundError, "nothing was written")],
)
def test_errors(tmp_path: Path, name: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message), atomic_path(tmp_path / name):
        pass


def test_permissions_are_those_of_a_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    with atomic_path(tmp_path / "a") as temporary:
        temporary.touch()
    assert len({stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "a")}) == 1
