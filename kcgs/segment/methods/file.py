"""Label maps on disk."""

import os

from torch import Tensor

from kcgs.segment.cleanup import Cleanup
from kcgs.segment.registry import register


@register("file", Cleanup(min_size=1, connected=False))
def file(image: Tensor, *, path: str | os.PathLike[str], threshold: float | None = None) -> Tensor:
    """Take the regions of an image from a mask on disk.

    By default there is no clean-up: small pieces stay, and a label in several pieces is one region.

    Args:
        image: as `segment` takes it.
        path: a file that `kcgs.data.load_labels` reads, of the image's size.
        threshold: for a mask with soft edges, as in `kcgs.data.load_labels`.

    Raises:
        FileNotFoundError: ``path`` does not exist.

    Example:
        >>> import tempfile, torch
        >>> from kcgs.data import save_labels
        >>> from kcgs.segment import segment
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_labels(f"{folder}/mask.png", torch.tensor([[255, 0, 0]]))
        ...     segment(torch.zeros(3, 1, 3), "file", path=f"{folder}/mask.png").tolist()
        [[1, 0, 0]]
    """
    from kcgs.data import load_labels

    return load_labels(path, threshold=threshold)
