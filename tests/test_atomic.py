"""``atomic_path``: whole files or none."""

import stat
from pathlib import Path

import pytest

from kcgs._atomic import atomic_path


class TestAtomicPath:
    def test_writes_and_leaves_nothing_else(self, tmp_path: Path) -> None:
        with atomic_path(tmp_path / "a.bin") as temporary:
            assert not temporary.exists()
            temporary.write_bytes(b"new")
            assert not (tmp_path / "a.bin").exists()
        assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]
        assert (tmp_path / "a.bin").read_bytes() == b"new"

    def test_temporary_is_beside_the_target_and_keeps_the_suffix(self, tmp_path: Path) -> None:
        with atomic_path(str(tmp_path / "scene.tar.png")) as temporary:
            assert temporary.parent == tmp_path
            assert temporary.suffix == ".png"
            temporary.touch()

    def test_two_writers_do_not_share_a_temporary(self, tmp_path: Path) -> None:
        with atomic_path(tmp_path / "a") as first, atomic_path(tmp_path / "a") as second:
            assert first != second
            first.write_text("first")
            second.write_text("second")
        assert (tmp_path / "a").read_text() == "first"

    def test_replaces_an_existing_file(self, tmp_path: Path) -> None:
        target = tmp_path / "a.txt"
        target.write_text("old")
        with atomic_path(target) as temporary:
            temporary.write_text("new")
        assert target.read_text() == "new"

    @pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
    def test_any_exception_removes_it_and_keeps_the_old(self, tmp_path: Path, error: type[BaseException]) -> None:
        target = tmp_path / "a.txt"
        target.write_text("old")
        with pytest.raises(error), atomic_path(target) as temporary:
            temporary.write_text("half")
            raise error
        assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
        assert target.read_text() == "old"

    def test_exception_before_anything_is_written(self, tmp_path: Path) -> None:
        with pytest.raises(RuntimeError), atomic_path(tmp_path / "a.txt"):
            raise RuntimeError
        assert list(tmp_path.iterdir()) == []

    def test_missing_folder_is_named(self, tmp_path: Path) -> None:
        with (
            pytest.raises(FileNotFoundError, match=r"folder .*nowhere does not exist"),
            atomic_path(tmp_path / "nowhere" / "a.txt"),
        ):
            pass

    def test_target_is_a_folder(self, tmp_path: Path) -> None:
        with pytest.raises(IsADirectoryError, match="is a folder"), atomic_path(tmp_path):
            pass

    def test_nothing_written_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match="nothing was written"), atomic_path(tmp_path / "a"):
            pass

    def test_permissions_are_those_of_a_new_file(self, tmp_path: Path) -> None:
        (tmp_path / "plain").touch()
        with atomic_path(tmp_path / "a") as temporary:
            temporary.touch()
        modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "a")}
        assert len(modes) == 1
