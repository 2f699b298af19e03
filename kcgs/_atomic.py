"""Files that appear whole or not at all."""

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def check_writable(name: str, path: str | os.PathLike[str]) -> None:
    """Raise an OSError that begins with `name` if no file can be written at `path`; leave nothing there."""
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
    """Yield a temporary path beside `path`, of the same suffix; at the end the file written there replaces `path`.

    On any exception, Ctrl-C included, the temporary file is removed, and a file that stood at `path` stays.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {target}: the folder {target.parent} does not exist")
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {target}: it is a folder, expected a file path")
    # not created here: the writer creates it, with the permissions of any new file
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
    """Write bytes, or a text in UTF-8, whole or not at all; return the number of bytes."""
    with atomic_path(path) as temporary:
        return temporary.write_bytes(content.encode() if isinstance(content, str) else content)
