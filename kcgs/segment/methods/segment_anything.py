"""Segment Anything and SAM 2 by transformers, prompted by points, boxes or a grid."""

import os
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs.segment.cleanup import Prediction
from kcgs.segment.networks import load_pretrained, preprocess
from kcgs.segment.registry import register

_AT_ONCE = 16  # Prompts per pass.
_STABILITY_OFFSET = 1.0  # Of Segment Anything's own automatic generator.


@register("sam")
def sam(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any = "facebook/sam2.1-hiera-tiny",
    boxes: Tensor | Sequence[Any] | None = None,
    points: Tensor | Sequence[Any] | None = None,
    point_labels: Tensor | Sequence[Any] | None = None,
    grid: int = 16,
    min_score: float = 0.88,
    min_stability: float = 0.95,
    max_overlap: float = 0.7,
) -> Prediction:
    """Segment by Segment Anything (Kirillov et al., ICCV 2023) or SAM 2 (Ravi et al., ICLR 2025).

    A box, or a set of points, asks for one object and gets its best mask. Without either, a grid of points asks for
    everything, and of its masks (three per point) those stay that the model scores at least ``min_score`` and that
    hardly depend on the threshold. Of masks that overlap by more than ``max_overlap`` (intersection over union) the
    better stays. Masks are painted from large to small, so that the smaller lies over the larger; each connected piece
    of what no mask covers is a region too. Scores are the overlap that the model predicts for each mask, NaN where
    there is none.

    Args:
        image: as `segment` takes it, any size.
        model: a hub id such as "facebook/sam2.1-hiera-tiny" or "facebook/sam-vit-base", a local folder, or a loaded
            ``SamModel`` or ``Sam2Model``.
        boxes: :math:`(K, 4)` left, top, right, bottom in pixels; these three may be lists too.
        points: :math:`(K, P, 2)` for K objects of P points each, (x, y) in pixels.
        point_labels: :math:`(K, P)`, 1 in the object and 0 outside; None: all 1.
        grid: points along each side where there are neither boxes nor points, at least 1.
        min_score: of the grid's masks, in [0, 1], against the overlap that the model predicts.
        min_stability: of the grid's masks, in [0, 1]: overlap of the mask at logits above 1 and above -1.
        max_overlap: in [0, 1].

    Raises:
        ValueError: an argument has another shape or is out of its range, or the weights do not fit the model.

    Example:
        ``segment(image, "sam", boxes=[[30, 40, 200, 180]])``
    """
    check_count("grid", grid)
    for name, value in (("min_score", min_score), ("min_stability", min_stability), ("max_overlap", max_overlap)):
        check_number(name, value, 0, 1)
    if boxes is not None and points is not None:
        raise ValueError("boxes must be None where there are points; got both")
    has_prompts = boxes is not None or points is not None
    if boxes is not None:
        corners = _to_tensor("boxes", boxes, (None, 4))
        prompts = {"input_boxes": corners[None]}
    else:
        places = _to_tensor("points", points, (None, None, 2)) if has_prompts else _grid_points(image, grid)
        inside = torch.ones(places.shape[:2])
        if point_labels is not None:
            inside = _to_tensor("point_labels", point_labels, tuple(places.shape[:2]))
        prompts = {"input_points": places[None], "input_labels": inside[None].long()}
    network = load_pretrained("AutoModelForMaskGeneration", model, image.device)
    side, (height, width) = network.prompt_encoder.input_image_size, image.shape[1:]
    size = (side, side)
    if network.config.model_type == "sam":  # It sees images in their shape, in a corner of the square.
        size = (round(height * side / max(height, width)), round(width * side / max(height, width)))
    shown = F.pad(preprocess(image, size), (0, side - size[1], 0, side - size[0]))
    logits, scores = _predict_masks(network, shown, prompts, torch.tensor([size[1] / width, size[0] / height]))
    if has_prompts:
        logits, scores = (
            torch.stack([row[k] for row, k in zip(t, scores.argmax(dim=1), strict=True)]) for t in (logits, scores)
        )
    else:
        logits, scores = logits.flatten(0, 1), scores.flatten()
        inner, outer = ((logits > offset).flatten(1).sum(dim=1) for offset in (_STABILITY_OFFSET, -_STABILITY_OFFSET))
        good = (scores >= min_score) & (inner >= min_stability * outer)
        logits, scores = logits[good], scores[good]
    labels = torch.zeros(height, width, dtype=torch.int64, device=image.device)
    painted = torch.full((height, width), float("nan"), device=image.device)
    for index, mask in enumerate(keep_apart(logits > 0, scores, max_overlap)):
        square = F.interpolate(logits[mask][None, None], (side, side), mode="bilinear", align_corners=False)
        corner = square[..., : size[0], : size[1]]
        inside = F.interpolate(corner, (height, width), mode="bilinear", align_corners=False)[0, 0] > 0
        labels[inside] = index + 1
        painted[inside] = scores[mask]
    return Prediction(labels, painted)


def keep_apart(masks: Tensor, scores: Tensor, max_overlap: float) -> list[int]:
    """Return which masks (M, h, w) overlap no better kept one too much, from large to small.

    Overlap is intersection over union. Of equal scores (M,) the earlier is the better; of equal areas it comes last.
    """
    flat = masks.flatten(1).float()
    areas = flat.sum(dim=1)
    shared = flat @ flat.T
    doubles = (shared > max_overlap * (areas[:, None] + areas[None] - shared)).tolist()
    kept: list[int] = []
    for mask in scores.argsort(descending=True, stable=True).tolist():
        if areas[mask] > 0 and not any(doubles[mask][other] for other in kept):
            kept.append(mask)
    return sorted(reversed(kept), key=lambda mask: -float(areas[mask]))


def _to_tensor(name: str, values: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Return what may be a list, as from the command line, as a tensor of a shape; None: any size."""
    words = f"{name} must be numbers of shape ({', '.join('any' if n is None else str(n) for n in shape)})"
    try:
        tensor = torch.as_tensor(values, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{words}; got {values!r}") from error
    sides = [n if n is not None else m for n, m in zip(shape, tensor.shape, strict=False)]
    if tensor.ndim != len(shape) or list(tensor.shape) != sides or not tensor.numel():
        raise ValueError(f"{words}; got {tuple(tensor.shape)}")
    return tensor


def _grid_points(image: Tensor, grid: int) -> Tensor:
    steps = (torch.arange(grid) + 0.5) / grid
    return torch.cartesian_prod(steps * image.shape[1], steps * image.shape[2]).flip(-1)[:, None]


@torch.no_grad()
def _predict_masks(network: Any, shown: Tensor, prompts: dict[str, Tensor], scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return logits (K, C, h, w) and predicted overlaps (K, C) of the masks of prompts (1, K, ...) in pixels."""
    embeddings = network.get_image_embeddings(shown)
    logits, scores = [], []
    for start in range(0, next(iter(prompts.values())).shape[1], _AT_ONCE):
        part = {name: values[:, start : start + _AT_ONCE] for name, values in prompts.items()}
        for name in ("input_boxes", "input_points"):
            if name in part:  # The prompt encoder adds half a pixel of its own.
                part[name] = (part[name].unflatten(-1, (-1, 2)) * scale - 0.5).flatten(-2)
        is_ambiguous = "input_points" in part and part["input_points"].shape[2] == 1
        part = {name: values.to(shown.device) for name, values in part.items()}
        result = network(image_embeddings=embeddings, multimask_output=is_ambiguous, **part)
        logits.append(result.pred_masks[0].float())
        scores.append(result.iou_scores[0].float())
    return torch.cat(logits), torch.cat(scores)
