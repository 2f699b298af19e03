"""Label maps that exist already: masks on disk, annotations of DAVIS."""

import os
from typing import Unpack

from torch import Tensor

from kcgs.segment.base import check_segment_image, register
from kcgs.segment.sources import CleanupOptions, cleanup_of


@register("file")
def file(image: Tensor, *, path: str | os.PathLike[str], **cleanup: Unpack[CleanupOptions]) -> Tensor:
    """Take the regions of an image from a mask on disk.

    Unless asked, nothing is cleaned: no piece is too small, and a label in several pieces is one region.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1].
        path: what `kcgs.data.load_labels` reads.
        cleanup: ``min_size``, ``snap``, ``max_regions`` and ``connected`` of `Cleanup`.

    Returns:
        :math:`(H, W)` int64 with ids 0 to R - 1 by decreasing area.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        TypeError: an argument has another type.
        ValueError: the file is no label map or has another size than the image.

    Example:
        >>> import tempfile, torch
        >>> from kcgs.data import save_labels
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_labels(f"{folder}/mask.png", torch.tensor([[255, 0, 0]]))
        ...     file(torch.zeros(3, 1, 3), path=f"{folder}/mask.png").tolist()
        [[1, 0, 0]]
    """
    from kcgs.data import load_labels

    check_segment_image(image)
    return _checked(image, load_labels(path), str(path), cleanup)


@register("davis")
def davis(
    image: Tensor,
    *,
    root: str | os.PathLike[str],
    sequence: str,
    frame: int = 0,
    resolution: str = "480p",
    **cleanup: Unpack[CleanupOptions],
) -> Tensor:
    """Take the regions of a frame of DAVIS from its annotation.

    Unless asked, nothing is cleaned: no piece is too small, and an object in several pieces is one region.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1], the frame.
        root: the folder that holds ``JPEGImages`` and ``Annotations``.
        sequence: its name.
        frame: its number; 0 is the first.
        resolution: the folder below these two.
        cleanup: ``min_size``, ``snap``, ``max_regions`` and ``connected`` of `Cleanup`.

    Returns:
        :math:`(H, W)` int64 with ids 0 to R - 1 by decreasing area.

    Raises:
        FileNotFoundError: ``root`` has another layout, or the frame is missing.
        TypeError: an argument has another type.
        ValueError: there is no such sequence, or its annotation has another size than the image.

    Example:
        ``segment(Davis(root)["cows"].image, "davis", root=root, sequence="cows")``
    """
    from kcgs.data import Davis

    check_segment_image(image)
    if not isinstance(sequence, str):
        raise TypeError(f"sequence must be a name; got {sequence!r}")
    labels = Davis(root, resolution=resolution, sequences=[sequence], frame=frame)[0].labels
    return _checked(image, labels, f"sequence {sequence!r}", cleanup)


def _checked(image: Tensor, labels: Tensor, name: str, cleanup: CleanupOptions) -> Tensor:
    rules = cleanup_of(cleanup, min_size=1, connected=False)
    if labels.shape != image.shape[-2:]:
        raise ValueError(
            f"the mask must have the image's size {tuple(image.shape[-2:])}; got {tuple(labels.shape)} in {name}"
        )
    return rules.apply(image.detach(), labels).labels
