"""Frames and annotations of the DAVIS video segmentation data sets, 2016 and 2017."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from kcgs._check import check_count
from kcgs._repr import brief
from kcgs.data.images import load_image
from kcgs.data.labels import load_labels
from kcgs.errors import InvalidArgument


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
        self._images = Path(root) / "JPEGImages" / resolution
        self._annotations = Path(root) / "Annotations" / resolution
        self._frame = check_count("frame", frame, least=0)
        first, second = ({file.name for file in tree.glob("*/")} for tree in (self._images, self._annotations))
        present = sorted(first & second)
        if not present:
            raise FileNotFoundError(
                f"root must hold JPEGImages/{resolution}/SEQUENCE/00000.jpg and "
                f"Annotations/{resolution}/SEQUENCE/00000.png, as DAVIS is distributed; got {root}"
            )
        self.sequences = present if sequences is None else sorted(set(sequences))
        for name in self.sequences:
            if name not in present:
                raise InvalidArgument("sequences", f"among {', '.join(present)}", repr(name))

    def __len__(self) -> int:
        """Return the number of sequences."""
        return len(self.sequences)

    def __iter__(self) -> Iterator[DavisFrame]:
        """Read one sequence after the other."""
        return (self[name] for name in self.sequences)

    def __getitem__(self, key: int | str) -> DavisFrame:
        """Read a frame by position or by the name of its sequence."""
        name = self.sequences[key] if isinstance(key, int) else key
        file = Path(name, f"{self._frame:05d}")
        image, labels = self._images / file.with_suffix(".jpg"), self._annotations / file.with_suffix(".png")
        return DavisFrame(name, load_image(image), load_labels(labels))
