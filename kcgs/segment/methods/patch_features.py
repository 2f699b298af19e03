"""Regions of alike patch features: DINO, DINOv2, DINOv3."""

import inspect
import os
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count
from kcgs.segment.networks import IMAGENET_MEAN, IMAGENET_STD, load_pretrained, preprocess
from kcgs.segment.registry import Prediction, register

# Clusters are added while one more explains at least this share of the features' variance.
_LEAST_SHARE = 0.03
_MAX_ITERATIONS = 50
_TOLERANCE = 1e-6
_GUIDE_EPS = 1e-3  # A variance of colour below which the guided filter smooths.


@register("dino")
def dino(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any = "facebook/dinov2-small",
    num_clusters: int | None = None,
    max_clusters: int = 10,
    longer_side: int = 518,
) -> Prediction:
    """Segment by k-means of the patch features of a self-supervised vision transformer.

    Features are made unit length. k-means starts from the feature farthest from the mean, then from those farthest from
    the starts there are, so that it is the same every time. Memberships of the patches (softmax of cosine similarity to
    the centres) are enlarged to pixels and follow the image's edges by guided filtering (He et al., TPAMI 2013), two
    patches wide; the largest wins and is the score.

    Args:
        image: as `segment` takes it, any size.
        model: a hub id, a local folder or a loaded model of transformers: DINO ("facebook/dino-vits16"), DINOv2 with or
            without registers, DINOv3 ("facebook/dinov3-vits16-pretrain-lvd1689m"), or another plain vision transformer.
        num_clusters: k, at least 1; None: one more as long as it explains 3 % of the variance of the features.
        max_clusters: the most that are tried then, at least 1.
        longer_side: of the image that the model sees, in pixels, rounded to whole patches, at least 1.

    Returns:
        The label map that `segment` returns; `segment_with_scores` adds :math:`(R,)` scores.

    Raises:
        FileNotFoundError: ``model`` is the path of a folder that is not there.
        TypeError, ValueError: as `segment`; ``model`` cannot be loaded or has no patches.

    Example:
        ``segment(image, "dino", model="facebook/dinov2-small", num_clusters=6)``
    """
    check_count("max_clusters", max_clusters)
    check_count("longer_side", longer_side)
    if num_clusters is not None:
        check_count("num_clusters", num_clusters)
    features = F.normalize(patch_features(image, model, longer_side), dim=-1)
    rows, columns = features.shape[:2]
    centers = _centers(features.flatten(0, 1), num_clusters, max_clusters)
    similarity = features @ F.normalize(centers, dim=-1).T
    # The sharpest the features allow: a patch at a centre belongs to it alone.
    spread = (1 - similarity.max(dim=-1).values).mean().clamp(min=1e-3)
    members = (similarity / spread).softmax(dim=-1).permute(2, 0, 1)
    patch = max(image.shape[1] / rows, image.shape[2] / columns)
    best = _to_pixel_edges(image, members, patch).max(dim=0)
    return Prediction(best.indices, best.values)


def patch_features(image: Tensor, model: str | os.PathLike[str] | Any, longer_side: int) -> Tensor:
    """Return the features (rows, columns, D) of an image (3, H, W) shown with its longer side at ``longer_side``."""
    network = load_pretrained("AutoModel", model, image.device)
    patch = getattr(network.config, "patch_size", None)
    if not isinstance(patch, int):
        raise ValueError(f"model must be a vision transformer with patches; got {type(network).__name__}")
    longer = max(image.shape[1:])
    rows, columns = (max(1, round(side * longer_side / longer / patch)) for side in image.shape[1:])
    shown = preprocess(image, (rows * patch, columns * patch), IMAGENET_MEAN, IMAGENET_STD)
    options = {"interpolate_pos_encoding": True}
    if "interpolate_pos_encoding" not in inspect.signature(network.forward).parameters:
        options = {}  # Later models place patches of any number by themselves.
    with torch.no_grad():
        tokens = network(pixel_values=shown, **options).last_hidden_state[0]
    if tokens.ndim != 2 or len(tokens) < rows * columns:
        raise ValueError(f"model must give a token for each patch, {rows * columns}; got {tuple(tokens.shape)}")
    # Class and register tokens come first.
    return torch.as_tensor(tokens[-rows * columns :].float()).reshape(rows, columns, -1)


def _centers(features: Tensor, num_clusters: int | None, max_clusters: int) -> Tensor:
    """Return (K, D), the centres of features (N, D), K as asked or chosen."""
    starts = [int((features - features.mean(dim=0)).norm(dim=-1).argmax())]
    limit = min(num_clusters or max_clusters, len(features))
    nearest = (features - features[starts[0]]).norm(dim=-1)
    while len(starts) < limit and float(nearest.max()) > 0:
        starts.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (features - features[starts[-1]]).norm(dim=-1))
    if num_clusters is not None:
        return _k_means(features, starts)
    total = float((features - features.mean(dim=0)).square().sum())
    best, left = features.mean(dim=0, keepdim=True), total
    for count in range(2, len(starts) + 1):
        centers = _k_means(features, starts[:count])
        remains = float(torch.cdist(features, centers).min(dim=1).values.square().sum())
        if left - remains < _LEAST_SHARE * total:
            break
        best, left = centers, remains
    return best


def _k_means(features: Tensor, starts: list[int]) -> Tensor:
    from kornia.contrib import KMeans

    devices = [features.device] if features.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices):  # It samples where empty clusters go.
        torch.manual_seed(0)
        means = KMeans(len(starts), features[starts], _TOLERANCE, _MAX_ITERATIONS)
        means.fit(features)
    return torch.as_tensor(means.cluster_centers)


def _to_pixel_edges(image: Tensor, members: Tensor, patch: float) -> Tensor:
    """Enlarge memberships (K, rows, columns) to the pixels' size, along the edges of (3, H, W)."""
    from kornia.filters import guided_blur

    size = (image.shape[1], image.shape[2])
    large = F.interpolate(members[None], size, mode="bilinear", align_corners=False)
    if len(members) == 1:
        return large[0]
    # Odd, and no window reaches further beyond a border than the image does.
    height, width = (min(2 * round(patch) + 1, 2 * side - 1) for side in size)
    guided = guided_blur(image[None], large, (height, width), _GUIDE_EPS, border_type="replicate")
    return torch.as_tensor(guided[0]).clamp(0, 1)
