"""Frames and annotations of the DAVIS video segmentation data sets, 2016 and 2017."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, overload

from torch import Tensor

from kcgs._check import check_count
from kcgs._repr import brief
from kcgs.data.images import load_image
from kcgs.data.labels import load_labels


@brief
class DavisFrame(NamedTuple):
    """One frame of a sequence, :math:`(3, H, W)` float32 RGB in [0, 1], and its labels, :math:`(H, W)` int64.

    They are as annotated: 0 and 255 in DAVIS 2016, object numbers in 2017.
    """

    sequence: str
    image: Tensor
    labels: Tensor


class DavisSequence(Sequence[DavisFrame]):
    """All frames of one sequence of DAVIS, each read on access; `Davis.sequence` makes it.

    Attributes:
        name: of the sequence.
    """

    def __init__(self, name: str, numbers: list[int], read: Callable[[str, int], DavisFrame]) -> None:
        self.name, self._numbers, self._read = name, numbers, read

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, key: int) -> DavisFrame: ...

    @overload
    def __getitem__(self, key: slice) -> DavisSequence: ...

    def __getitem__(self, key: int | slice) -> DavisFrame | DavisSequence:
        """Read the frame at a position; a slice is the shorter sequence, not yet read."""
        if isinstance(key, slice):
            return DavisSequence(self.name, self._numbers[key], self._read)
        return self._read(self.name, self._numbers[key])

    def __repr__(self) -> str:
        return f"DavisSequence({self.name!r}, {len(self)} frames)"


class Davis:
    """A folder of DAVIS in its official layout, one frame of each sequence.

    The layout is ``JPEGImages/480p/SEQUENCE/00000.jpg`` and ``Annotations/480p/SEQUENCE/00000.png``.
    Sequences that have a folder in both trees are listed; files are read on access.

    Args:
        root: the folder that holds ``JPEGImages`` and ``Annotations``.
        resolution: the folder below these two, "480p" in the usual download.
        sequences: names to keep; None keeps all.
        frame: which frame of every sequence, the number in its file name.

    Raises:
        FileNotFoundError: ``root`` does not have this layout.
        ValueError: ``sequences`` names one that is not there, or ``frame`` is negative.

    Example:
        >>> import tempfile, torch
        >>> from kcgs.data import save_image, save_labels
        >>> with tempfile.TemporaryDirectory() as root:
        ...     for tree in ("JPEGImages", "Annotations"):
        ...         (Path(root) / tree / "480p" / "cows").mkdir(parents=True)
        ...     save_image(f"{root}/JPEGImages/480p/cows/00000.jpg", torch.zeros(3, 4, 6))
        ...     save_labels(f"{root}/Annotations/480p/cows/00000.png", torch.ones(4, 6).long())
        ...     davis = Davis(root)
        ...     name, image, labels = davis["cows"]
        ...     cows = [frame.labels.max().item() for frame in davis.sequence("cows")]
        >>> davis.sequences, tuple(image.shape), tuple(labels.shape), cows
        (['cows'], (3, 4, 6), (4, 6), [1])
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        resolution: str = "480p",
        sequences: Iterable[str] | None = None,
        frame: int = 0,
    ) -> None:
        check_count("frame", frame, least=0)
        self._images = Path(root) / "JPEGImages" / resolution
        self._annotations = Path(root) / "Annotations" / resolution
        self._frame = frame
        trees = (self._images, self._annotations)
        for tree in trees:
            if not tree.is_dir():
                raise FileNotFoundError(
                    f"no folder {tree}: root must hold JPEGImages/RESOLUTION/SEQUENCE/00000.jpg and "
                    "Annotations/RESOLUTION/SEQUENCE/00000.png, as DAVIS is distributed"
                )
        first, second = ({entry.name for entry in tree.iterdir() if entry.is_dir()} for tree in trees)
        present = sorted(first & second)
        if not present:
            raise FileNotFoundError(f"no sequence has a folder in both {trees[0]} and {trees[1]}")
        self._sequences = present if sequences is None else self._select(sequences, present)

    @property
    def sequences(self) -> list[str]:
        """The names of the sequences, sorted."""
        return list(self._sequences)

    def __len__(self) -> int:
        """Return the number of sequences."""
        return len(self._sequences)

    def __iter__(self) -> Iterator[DavisFrame]:
        """Read one sequence after the other."""
        return (self[name] for name in self._sequences)

    def __getitem__(self, key: int | str) -> DavisFrame:
        """Read a frame by position or by the name of its sequence; the annotation has to have its size."""
        if isinstance(key, bool) or not isinstance(key, int | str):
            raise TypeError(f"a frame is looked up by position or sequence name; got {key!r}")
        if isinstance(key, int) and not -len(self) <= key < len(self):
            raise IndexError(f"there are {len(self)} sequences; got position {key}")
        name = self._sequences[key] if isinstance(key, int) else self._select([key], self._sequences)[0]
        return self._read(name, self._frame)

    def sequence(self, name: str) -> DavisSequence:
        """Take a whole sequence: all frames that have an image, each with its labels, read one at a time.

        Args:
            name: one of ``sequences``.

        Returns:
            A sequence of DavisFrames, which reads on access; every pass starts anew.

        Raises:
            FileNotFoundError: no image is there; on access, a frame lacks its annotation.
            ValueError: there is no sequence of this name.
        """
        name = self._select([name], self._sequences)[0]
        numbers = sorted(int(path.stem) for path in (self._images / name).glob("*.jpg") if path.stem.isdigit())
        if not numbers:
            raise FileNotFoundError(f"sequence {name!r} has no frames in {self._images / name}")
        return DavisSequence(name, numbers, self._read)

    def _read(self, name: str, frame: int) -> DavisFrame:
        image_path = self._images / name / f"{frame:05d}.jpg"
        labels_path = self._annotations / name / f"{frame:05d}.png"
        for path in (image_path, labels_path):
            if not path.is_file():
                raise FileNotFoundError(f"frame {frame} of sequence {name!r} lacks {path}")
        image, labels = load_image(image_path), load_labels(labels_path)
        if image.shape[-2:] != labels.shape:
            raise ValueError(
                f"sequence {name!r}: frame and annotation must have one size; "
                f"got {tuple(image.shape[-2:])} in {image_path} and {tuple(labels.shape)} in {labels_path}"
            )
        return DavisFrame(name, image, labels)

    @staticmethod
    def _select(names: Iterable[str], present: list[str]) -> list[str]:
        if isinstance(names, str):
            raise TypeError(f"sequences must be a list of names; got the string {names!r}")
        chosen = sorted(set(names))
        for name in chosen:
            if name not in present:
                few = ", ".join(present[:5]) + (", ..." if len(present) > 5 else "")
                raise ValueError(f"no sequence {name!r}; there are {len(present)}: {few}")
        return chosen
