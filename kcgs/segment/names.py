"""What regions are called: names of classes, and which of them a region has."""

import os
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor


def read_names(names: Sequence[str] | str | os.PathLike[str] | None) -> list[str] | None:
    """Return names of classes in the order of their numbers, class 0 first.

    Args:
        names: the names, or a text file with one a line, UTF-8; None: there are none.

    Raises:
        FileNotFoundError: there is no such file.
        TypeError: ``names`` is neither a path nor a list of strings.
        ValueError: the file is no text, or there is no name.

    Example:
        >>> read_names(["sky", "dog"])
        ['sky', 'dog']
    """
    if names is None:
        return None
    if isinstance(names, str | os.PathLike):
        path = Path(names)
        if not path.is_file():
            raise FileNotFoundError(f"no names of classes at {path}")
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(f"cannot read {path} as UTF-8 text with a name a line") from error
        # an empty line within counts: the numbers of the classes are those of the lines
        names = [line.strip() for line in "\n".join(lines).rstrip().split("\n")]
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"names must be a list of strings, or a text file with one a line; got {names!r}")
    if not any(names):
        raise ValueError("names must have at least one name; got none")
    return list(names)


def check_names(names: Sequence[str], classes: int) -> None:
    """Refuse names of another number than the classes'."""
    if len(names) != classes:
        raise ValueError(f"names must be {classes}, one a class, class 0 first; got {len(names)}")


def region_names(labels: Tensor, classes: Tensor, names: Sequence[str]) -> dict[int, str]:
    """Return what every region is called: as the class that most of its pixels have.

    Args:
        labels: :math:`(H, W)` int64, ids 0 to R - 1.
        classes: :math:`(H, W)` int64, places in ``names``.
        names: of the classes.

    Example:
        >>> import torch
        >>> region_names(torch.tensor([[0, 0, 0, 1]]), torch.tensor([[2, 2, 0, 0]]), ["sky", "dog", "cat"])
        {0: 'cat', 1: 'sky'}
    """
    pairs = (labels * len(names) + classes.to(labels.device)).flatten()
    counts = pairs.bincount(minlength=(int(labels.max()) + 1) * len(names)).reshape(-1, len(names))
    return {region: names[kind] for region, kind in enumerate(counts.argmax(dim=1).tolist())}
