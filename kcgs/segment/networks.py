"""Load networks, resize and normalise images for them, and turn their scores into labels."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._repr import shorten

from .cleanup import Prediction

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# characters of a library's error that are shown: some list every weight of a network
_MAX_ERROR_LENGTH = 240
# name of pixels without a class
_BACKGROUND = "background"


@contextmanager
def library_errors(message: str) -> Iterator[None]:
    """Raise any error of a library, such as for damaged files or wrong weights, as a ValueError."""
    try:
        yield
    except Exception as error:
        line = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{message}: {shorten(line, _MAX_ERROR_LENGTH)}") from error


def load_pretrained(class_name: str, model: Any, device: torch.device) -> Any:
    """Return a model of transformers in evaluation mode; `model` is a folder, a hub id or a loaded model."""
    try:
        import transformers
    except ImportError as error:
        raise ImportError("this method needs the package transformers: pip install transformers") from error
    if isinstance(model, torch.nn.Module):
        return model.eval().to(device)
    with library_errors(f"cannot load {str(model)!r} as {class_name}"):
        loaded, info = getattr(transformers, class_name).from_pretrained(os.fspath(model), output_loading_info=True)
        # many published checkpoints lack a pooling head, and no method reads it
        missing = sorted(key for key in info["missing_keys"] if "pooler" not in key)
        if missing:
            raise ValueError(f"it lacks {len(missing)} weights, as {missing[0]}")
    return loaded.eval().to(device)


def preprocess(
    image: Tensor, size: tuple[int, int], mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD
) -> Tensor:
    """Resize an image (3, H, W) to (1, 3, h, w), subtract ``mean`` and divide by ``std``."""
    image = F.interpolate(image[None], size, mode="bilinear", align_corners=False, antialias=True)
    return (image - image.new_tensor(mean)[:, None, None]) / image.new_tensor(std)[:, None, None]


def predict_labels(
    logits: Tensor, size: tuple[int, ...], names: Sequence[str] | None = None, threshold: float | None = None
) -> Prediction:
    """Enlarge logits (C, h, w) to ``size``; the class with the largest logit is the label, its softmax the score.

    With a ``threshold``, a pixel is background if its largest sigmoid is at most the threshold: label 0, with 1 minus
    this sigmoid as score; other labels increase by 1. Classes are enlarged one by one to save memory.
    """
    best = torch.full(size, -torch.inf, device=logits.device)
    total, labels = best.clone(), torch.zeros(size, dtype=torch.int64, device=logits.device)
    for label, small in enumerate(logits):
        large = F.interpolate(small[None, None].float(), size, mode="bilinear", align_corners=False)[0, 0]
        labels[large > best] = label
        best = torch.maximum(best, large)
        total = torch.logaddexp(total, large)
    if threshold is None:
        return Prediction(labels, (best - total).exp(), names)
    inside = best.sigmoid() > threshold
    scores = torch.where(inside, best.sigmoid(), 1 - best.sigmoid())
    return Prediction(torch.where(inside, labels + 1, 0), scores, names and [_BACKGROUND, *names])
