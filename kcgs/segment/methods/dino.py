"""Regions of similar patch features, by DINO, DINOv2 or DINOv3."""

import inspect
import os
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count
from kcgs.errors import InvalidArgument
from kcgs.segment.cleanup import Prediction
from kcgs.segment.clustering import k_means
from kcgs.segment.networks import load_pretrained, preprocess
from kcgs.segment.registry import register

# the guided filter smooths where the variance of colour is below this
_GUIDE_EPS = 1e-3
# least mean distance of features to the centres of their clusters, as 1 - cosine
_MIN_SPREAD = 1e-3


@register("dino")
def dino(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any = "facebook/dinov2-small",
    num_clusters: int = 6,
    longer_side: int = 518,
) -> Prediction:
    """Segment by k-means of the patch features of a self-supervised vision transformer.

    Features of unit length are clustered. The membership of a patch in a cluster is the softmax of its cosine
    similarities to the clusters' means. Memberships are enlarged to pixels, and a guided filter (He et al., TPAMI
    2013), two patches wide, aligns them with the image's edges. The largest membership gives the label and the score.

    Args:
        image: as `segment` takes it, any size.
        model: a hub id, a local folder or a loaded model of transformers: DINO ("facebook/dino-vits16"), DINOv2 with or
            without registers, DINOv3 ("facebook/dinov3-vits16-pretrain-lvd1689m"), or another plain vision transformer.
        num_clusters: k, at least 1.
        longer_side: longer side of the image that the model sees, in pixels, rounded to whole patches, at least 1.

    Raises:
        ValueError: ``model`` cannot be loaded or has no patches.

    Example:
        ``segment(image, "dino", model="facebook/dinov2-small", num_clusters=6)``
    """
    check_count("longer_side", longer_side)
    features = F.normalize(patch_features(image, model, longer_side), dim=-1)
    rows, columns = features.shape[:2]
    clusters = torch.from_numpy(k_means(features.flatten(0, 1).double().cpu().numpy(), num_clusters)).to(image.device)
    assignment = F.one_hot(clusters)[:, clusters.bincount() > 0].to(features)  # [N, K]
    similarity = features @ F.normalize(assignment.T @ features.flatten(0, 1), dim=-1).T
    # a patch at the centre of a cluster belongs to that cluster alone
    spread = (1 - similarity.max(dim=-1).values).mean().clamp(min=_MIN_SPREAD)
    memberships = (similarity / spread).softmax(dim=-1).permute(2, 0, 1)
    patch = max(image.shape[1] / rows, image.shape[2] / columns)
    best = _enlarge_along_edges(image, memberships, patch).max(dim=0)
    return Prediction(best.indices, best.values)


def patch_features(image: Tensor, model: str | os.PathLike[str] | Any, longer_side: int) -> Tensor:
    """Return the features (rows, columns, D) of an image (3, H, W) shown with its longer side at ``longer_side``."""
    network = load_pretrained("AutoModel", model, image.device)
    patch = getattr(network.config, "patch_size", None)
    if not isinstance(patch, int):
        raise InvalidArgument("model", "a vision transformer with patches", type(network).__name__)
    longer = max(image.shape[1:])
    rows, columns = (max(1, round(side * longer_side / longer / patch)) for side in image.shape[1:])
    # DINO takes another number of patches only with this option; later models always do
    options = {"interpolate_pos_encoding"} & inspect.signature(network.forward).parameters.keys()
    with torch.no_grad():
        pixels = preprocess(image, (rows * patch, columns * patch))
        tokens = network(pixel_values=pixels, **dict.fromkeys(options, True)).last_hidden_state[0]
    # class and register tokens come first
    return torch.as_tensor(tokens[-rows * columns :].float()).reshape(rows, columns, -1)


def _enlarge_along_edges(image: Tensor, memberships: Tensor, patch: float) -> Tensor:
    """Enlarge memberships (K, rows, columns) to the size of an image (3, H, W), along its edges."""
    from kornia.filters import guided_blur

    size = (image.shape[1], image.shape[2])
    large = F.interpolate(memberships[None], size, mode="bilinear", align_corners=False)
    # sides are odd, and less than twice the image's: a window must not reach beyond a border by more than the image
    height, width = (min(2 * round(patch) + 1, 2 * side - 1) for side in size)
    guided = guided_blur(image[None], large, (height, width), _GUIDE_EPS, border_type="replicate")
    return torch.as_tensor(guided[0]).clamp(0, 1)
