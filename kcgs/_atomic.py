"""Files that appear whole or not at all."""

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def check_writable(name: str, path: str | os.PathLike[str]) -> None:
    """Refuse, by an OSError that begins with `name`, a path at which no file can be written; nothing appears there."""
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(f"{name} must be a file; {str(target)!r} is a folder")
    folder = target.resolve().parent
    if not folder.is_dir():
        raise FileNotFoundError(f"{name} needs an existing folder; {str(folder)!r} is not there")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise type(error)(f"{name} cannot be written into {str(folder)!r}: {error.strerror}") from error


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path beside `path`, of the same suffix, at which the block writes a file that takes its place at the end.

    On any exception, Ctrl-C included, it is removed and whatever stood at `path` stays.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {target}: the folder {target.parent} does not exist")
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {target}: it is a folder, expected a file path")
    # Not created here: the writer creates it, and so the file gets the permissions any new file would.
    temporary = target.with_name(f".tmp-{uuid.uuid4().hex}{target.suffix}")
    try:
        yield temporary
        if not temporary.is_file():
            raise FileNotFoundError(f"nothing was written for {target}")
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and str(error.filename) == str(temporary):
            error.filename = str(target)
        raise


def write_file(path: str | os.PathLike[str], content: bytes | str) -> int:
    """Write bytes, or a text in UTF-8, whole or not at all; return how many bytes."""
    with atomic_path(path) as temporary:
        return temporary.write_bytes(content.encode() if isinstance(content, str) else content)
