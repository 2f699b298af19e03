"""What the methods that run a network share: loading, resizing and normalising images, labels from scores, k-means."""

import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count
from kcgs.segment.cleanup import Prediction

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_LONGEST = 240  # Of an error's line: libraries list every weight.
# More rows than this add nothing to the centres of clusters.
_SAMPLE = 100_000
_BACKGROUND = "background"  # What is no class's is called so.


@contextmanager
def errors_of(words: str) -> Iterator[None]:
    """Make ValueErrors of what a library raises: of damaged files, other weights, a missing network, odd values."""
    try:
        yield
    except Exception as error:
        lines = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{words}: {lines if len(lines) <= _LONGEST else lines[:_LONGEST] + ' ...'}") from error


def load_pretrained(class_name: str, model: Any, device: torch.device) -> Any:
    """Return a model of transformers in evaluation mode, from a folder, a hub id, or loaded already."""
    try:
        import transformers
    except ImportError as error:
        raise ImportError("this method needs the package transformers: pip install 'kcgs[segment]'") from error
    if isinstance(model, torch.nn.Module):
        return model.eval().to(device)
    with errors_of(f"cannot load {str(model)!r} as {class_name}"):
        loaded, info = getattr(transformers, class_name).from_pretrained(os.fspath(model), output_loading_info=True)
        # Pooling heads are no part of many published checkpoints, and nothing here reads them.
        missing = sorted(key for key in info["missing_keys"] if "pooler" not in key)
        if missing:
            raise ValueError(f"it lacks {len(missing)} weights, as {missing[0]}")
    return loaded.eval().to(device)


def preprocess(
    image: Tensor, size: tuple[int, int], mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD
) -> Tensor:
    """Return (3, H, W) as (1, 3, h, w) of ``size``, less ``mean``, over ``std``."""
    image = F.interpolate(image[None], size, mode="bilinear", align_corners=False, antialias=True)
    return (image - image.new_tensor(mean)[:, None, None]) / image.new_tensor(std)[:, None, None]


def predict_labels(
    logits: Tensor, size: tuple[int, ...], names: Sequence[str] | None = None, threshold: float | None = None
) -> Prediction:
    """Enlarge logits (C, h, w) to ``size``; the largest wins, and its softmax is the score.

    With a ``threshold``, pixels whose largest sigmoid is not above it are background, label 0 with one less that
    sigmoid as score; the other labels are one higher. One class at a time is enlarged, so that many classes of a large
    image fit.
    """
    best = torch.full(size, -torch.inf, device=logits.device)
    total, labels = best.clone(), torch.zeros(size, dtype=torch.int64, device=logits.device)
    for k, plane in enumerate(logits):
        one = F.interpolate(plane[None, None].float(), size, mode="bilinear", align_corners=False)[0, 0]
        labels[one > best] = k
        best = torch.maximum(best, one)
        total = torch.logaddexp(total, one)
    if threshold is None:
        return Prediction(labels, (best - total).exp(), names)
    inside = best.sigmoid() > threshold
    scores = torch.where(inside, best.sigmoid(), 1 - best.sigmoid())
    return Prediction(torch.where(inside, labels + 1, 0), scores, names and [_BACKGROUND, *names])


def k_means(values: NDArray[Any], num_clusters: int) -> NDArray[np.int64]:
    """Return the cluster of every row of (N, D), the same every time; fewer clusters where rows are alike."""
    from scipy.cluster.vq import kmeans2, vq

    check_count("num_clusters", num_clusters)
    sample = values[:: math.ceil(len(values) / _SAMPLE)]
    with warnings.catch_warnings(action="ignore"):  # of clusters that stay empty
        centers, _ = kmeans2(sample, num_clusters, iter=20, minit="++", rng=0)
    return np.asarray(vq(values, centers)[0], dtype=np.int64)
