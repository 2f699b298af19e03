"""First frames and annotations of the DAVIS video segmentation data sets, 2016 and 2017."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from kcgs._repr import brief

from .images import load_image
from .labels import load_labels


@brief
class DavisFrame(NamedTuple):
    """The first frame of a sequence, :math:`(3, H, W)` float32 RGB in [0, 1], and its labels, :math:`(H, W)` int64.

    The labels are those of the annotation: 0 and 255 in DAVIS 2016, object numbers in 2017.
    """

    sequence: str
    image: Tensor
    labels: Tensor


class Davis:
    """The sequences of a DAVIS folder at 480p in its official layout, by name.

    The layout is ``JPEGImages/480p/SEQUENCE/00000.jpg`` and ``Annotations/480p/SEQUENCE/00000.png``. A sequence has a
    folder in both trees; its files are read on access.

    Args:
        root: the folder that holds ``JPEGImages`` and ``Annotations``.

    Raises:
        FileNotFoundError: ``root`` does not have this layout.

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

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self._images = Path(root) / "JPEGImages" / "480p"
        self._annotations = Path(root) / "Annotations" / "480p"
        first, second = ({folder.name for folder in tree.glob("*/")} for tree in (self._images, self._annotations))
        self.sequences = sorted(first & second)
        if not self.sequences:
            raise FileNotFoundError(
                "root must hold JPEGImages/480p/SEQUENCE/00000.jpg and Annotations/480p/SEQUENCE/00000.png, "
                f"as DAVIS is distributed; got {root}"
            )

    def __len__(self) -> int:
        """Return the number of sequences."""
        return len(self.sequences)

    def __iter__(self) -> Iterator[DavisFrame]:
        """Yield the first frame of one sequence after another."""
        return (self[name] for name in self.sequences)

    def __getitem__(self, key: int | str) -> DavisFrame:
        """Read the first frame of a sequence, by the position or the name of the sequence."""
        name = key if isinstance(key, str) else self.sequences[key]
        image, labels = self._images / name / "00000.jpg", self._annotations / name / "00000.png"
        return DavisFrame(name, load_image(image), load_labels(labels))
