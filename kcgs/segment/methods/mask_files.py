"""Label maps that exist already: masks on disk, annotations of DAVIS."""

import os

from torch import Tensor

from kcgs.segment.registry import Cleanup, register

_AS_STORED = Cleanup(min_size=1, connected=False)


@register("file", _AS_STORED)
def file(image: Tensor, *, path: str | os.PathLike[str]) -> Tensor:
    """Take the regions of an image from a mask on disk.

    Unless asked, nothing is cleaned: no piece is too small, and a label in several pieces is one region.

    Args:
        image: as `segment` takes it; the result is that of `segment` too.
        path: what `kcgs.data.load_labels` reads.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        TypeError, ValueError: as `segment`; the file is no label map or has another size than the image.

    Example:
        >>> import tempfile, torch
        >>> from kcgs.data import save_labels
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_labels(f"{folder}/mask.png", torch.tensor([[255, 0, 0]]))
        ...     file(torch.zeros(3, 1, 3), path=f"{folder}/mask.png").tolist()
        [[1, 0, 0]]
    """
    from kcgs.data import load_labels

    return load_labels(path)


@register("davis", _AS_STORED)
def davis(
    image: Tensor, *, root: str | os.PathLike[str], sequence: str, frame: int = 0, resolution: str = "480p"
) -> Tensor:
    """Take the regions of a frame of DAVIS from its annotation, cleaned no more than by `file`.

    Args:
        image: as `segment` takes it, the frame; the result is that of `segment` too.
        root: the folder that holds ``JPEGImages`` and ``Annotations``.
        sequence: its name.
        frame: its number; 0 is the first.
        resolution: the folder below these two.

    Raises:
        FileNotFoundError: ``root`` has another layout, or the frame is missing.
        TypeError, ValueError: as `segment`; no such sequence, or an annotation of another size than the image.

    Example:
        ``segment(Davis(root)["cows"].image, "davis", root=root, sequence="cows")``
    """
    from kcgs.data import Davis

    if not isinstance(sequence, str):
        raise TypeError(f"sequence must be a name; got {sequence!r}")
    return Davis(root, resolution=resolution, sequences=[sequence], frame=frame)[0].labels
