"""Frames and annotations of the DAVIS video segmentation data sets, 2016 and 2017."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

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
        >>> davis.sequences, tuple(image.shape), tuple(labels.shape)
        (['cows'], (3, 4, 6), (4, 6))
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
        image_path = self._images / name / f"{self._frame:05d}.jpg"
        labels_path = self._annotations / name / f"{self._frame:05d}.png"
        for path in (image_path, labels_path):
            if not path.is_file():
                raise FileNotFoundError(f"frame {self._frame} of sequence {name!r} lacks {path}")
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
