"""Regions of alike patch features: DINO, DINOv2, DINOv3."""

import inspect
import os
from typing import Any, Unpack

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs.segment.base import check_segment_image
from kcgs.segment.cleanup import check_count
from kcgs.segment.sources import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    CleanupOptions,
    Segmentation,
    cleanup_of,
    load_pretrained,
    normalized,
    register_scored,
    require,
)

# Clusters are added while one more explains at least this share of the features' variance.
_WORTH = 0.03
_MAX_ITERATIONS = 50
_TOLERANCE = 1e-6
_GUIDE_EPS = 1e-3  # A variance of colour below which the guided filter smooths.


@register_scored("dino")
def dino(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any = "facebook/dinov2-small",
    clusters: int | None = None,
    max_clusters: int = 10,
    size: int = 518,
    **cleanup: Unpack[CleanupOptions],
) -> Segmentation:
    """Segment by k-means of the patch features of a self-supervised vision transformer.

    Features are made unit length. k-means starts from the feature farthest from the mean, then from those
    farthest from the starts there are, so that it is the same every time. Memberships of the patches (softmax of
    cosine similarity to the centres) are enlarged to pixels and follow the image's edges by guided filtering
    (He et al., TPAMI 2013), two patches wide; the largest wins and is the score.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1], any size.
        model: a hub id, a local folder or a loaded model of transformers: DINO ("facebook/dino-vits16"),
            DINOv2 with or without registers, DINOv3 ("facebook/dinov3-vits16-pretrain-lvd1689m"), or another
            plain vision transformer.
        clusters: how many kinds of patches, at least 1; None: one more as long as it explains 3 % of the
            variance of the features.
        max_clusters: the most that are tried then, at least 1.
        size: pixels of the longer side that the model sees, rounded to whole patches, at least 1.
        cleanup: ``min_size``, ``snap``, ``max_regions`` and ``connected`` of `Cleanup`.

    Returns:
        :math:`(H, W)` int64 with ids 0 to R - 1 by decreasing area; `segment_with_scores` adds :math:`(R,)`
        scores.

    Raises:
        FileNotFoundError: ``model`` is the path of a folder that is not there.
        ImportError: transformers is not installed.
        TypeError: an argument has another type.
        ValueError: an argument is out of its range, or ``model`` cannot be loaded or has no patches.

    Example:
        ``segment(image, "dino", model="facebook/dinov2-small", clusters=6)``
    """
    pixels = torch.from_numpy(check_segment_image(image)).permute(2, 0, 1).to(image.device)
    rules = cleanup_of(cleanup)
    for name, count in (("max_clusters", max_clusters), ("size", size)):
        check_count(name, count)
    if clusters is not None:
        check_count("clusters", clusters)
    features = F.normalize(patch_features(pixels, model, size), dim=-1)
    rows, columns = features.shape[:2]
    centers = _centers(features.flatten(0, 1), clusters, max_clusters)
    similarity = features @ F.normalize(centers, dim=-1).T
    # The sharpest the features allow: a patch at a centre belongs to it alone.
    spread = (1 - similarity.max(dim=-1).values).mean().clamp(min=1e-3)
    members = (similarity / spread).softmax(dim=-1).permute(2, 0, 1)
    patch = max(pixels.shape[1] / rows, pixels.shape[2] / columns)
    best = _to_pixel_edges(pixels, members, patch).max(dim=0)
    return rules.apply(image.detach(), best.indices, best.values)


def patch_features(pixels: Tensor, model: str | os.PathLike[str] | Any, size: int) -> Tensor:
    """Return the features (rows, columns, D) of an image (3, H, W) shown with its longer side at ``size``."""
    network = load_pretrained("AutoModel", model, "dino", pixels.device)
    patch = getattr(network.config, "patch_size", None)
    if not isinstance(patch, int):
        raise ValueError(f"model must be a vision transformer with patches; got {type(network).__name__}")
    longer = max(pixels.shape[1:])
    rows, columns = (max(1, round(side * size / longer / patch)) for side in pixels.shape[1:])
    shape = (rows * patch, columns * patch)
    shown = F.interpolate(pixels[None], shape, mode="bilinear", align_corners=False, antialias=True)
    options = {"interpolate_pos_encoding": True}
    if "interpolate_pos_encoding" not in inspect.signature(network.forward).parameters:
        options = {}  # Later models place patches of any number by themselves.
    with torch.no_grad():
        tokens = network(pixel_values=normalized(shown, IMAGENET_MEAN, IMAGENET_STD), **options).last_hidden_state[0]
    if tokens.ndim != 2 or len(tokens) < rows * columns:
        raise ValueError(f"model must give a token a patch, {rows * columns}; got {tuple(tokens.shape)}")
    # Class and register tokens come first.
    return torch.as_tensor(tokens[-rows * columns :].float()).reshape(rows, columns, -1)


def _centers(features: Tensor, clusters: int | None, max_clusters: int) -> Tensor:
    """Return (K, D), the centres of features (N, D), K as asked or chosen."""
    starts = [int((features - features.mean(dim=0)).norm(dim=-1).argmax())]
    limit = min(clusters or max_clusters, len(features))
    nearest = (features - features[starts[0]]).norm(dim=-1)
    while len(starts) < limit and float(nearest.max()) > 0:
        starts.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (features - features[starts[-1]]).norm(dim=-1))
    if clusters is not None:
        return _k_means(features, starts)
    total = float((features - features.mean(dim=0)).square().sum())
    best, left = features.mean(dim=0, keepdim=True), total
    for count in range(2, len(starts) + 1):
        centers = _k_means(features, starts[:count])
        remains = float(torch.cdist(features, centers).min(dim=1).values.square().sum())
        if left - remains < _WORTH * total:
            break
        best, left = centers, remains
    return best


def _k_means(features: Tensor, starts: list[int]) -> Tensor:
    contrib = require("kornia.contrib.kmeans", "kornia", "dino")
    devices = [features.device] if features.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices):  # It draws where empty clusters go to.
        torch.manual_seed(0)
        means = contrib.KMeans(len(starts), features[starts], _TOLERANCE, _MAX_ITERATIONS)
        means.fit(features)
    return torch.as_tensor(means.cluster_centers)


def _to_pixel_edges(pixels: Tensor, members: Tensor, patch: float) -> Tensor:
    """Enlarge memberships (K, rows, columns) to the pixels' size, along the edges of (3, H, W)."""
    filters = require("kornia.filters", "kornia", "dino")
    size = (pixels.shape[1], pixels.shape[2])
    large = F.interpolate(members[None], size, mode="bilinear", align_corners=False)
    if len(members) == 1:
        return large[0]
    # Odd, and no window reaches further beyond a border than the image does.
    height, width = (min(2 * round(patch) + 1, 2 * side - 1) for side in size)
    guided = filters.guided_blur(pixels[None], large, (height, width), _GUIDE_EPS, border_type="replicate")
    return torch.as_tensor(guided[0]).clamp(0, 1)
