"""Segment Anything and SAM 2 by transformers, prompted by points, boxes or a grid."""

import os
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs.errors import InvalidArgument
from kcgs.segment.cleanup import Cleanup, Prediction, merge_small
from kcgs.segment.cutting import NAMES
from kcgs.segment.networks import load_pretrained, preprocess
from kcgs.segment.prompts import Points, Prompt, check_prompt
from kcgs.segment.registry import register

# prompts per pass of the network
_BATCH = 16
# as in Segment Anything's automatic generator: least overlap of the masks at logits above +offset and above -offset
_MIN_STABILITY = 0.95
_STABILITY_OFFSET = 1.0
# largest intersection over union of two masks that are both kept
_MAX_OVERLAP = 0.7


@register("sam", takes_cleanup=True)
def sam(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any = "facebook/sam2.1-hiera-tiny",
    box: Points | None = None,
    foreground: Points | None = None,
    background: Points | None = None,
    grid: int = 16,
    min_score: float = 0.88,
    cleanup: Cleanup,
) -> Prediction:
    """Segment by Segment Anything (Kirillov et al., ICCV 2023) or SAM 2 (Ravi et al., ICLR 2025).

    A box, points of an object, or both prompt for this object; the result is its best mask. Without them, the prompts
    are a grid of points, with three masks per point. A mask is kept if the model scores it at least ``min_score`` and
    it hardly depends on the threshold. Of two masks that overlap by more than 0.7 (intersection over union) the better
    is kept. Smaller masks lie over larger ones. Each connected piece that no mask covers is a region too. The score of
    a region is the overlap that the model predicts for its mask, NaN without a mask. With a prompt the names of regions
    are "object" and "background".

    Args:
        image: as `segment` takes it, any size.
        model: a hub id such as "facebook/sam2.1-hiera-tiny" or "facebook/sam-vit-base", a local folder, or a loaded
            ``SamModel`` or ``Sam2Model``.
        box: left, top, right, bottom of one object, in pixels.
        foreground: :math:`(P, 2)` points (x, y) of the object, in pixels, in the box if there is one.
        background: :math:`(P, 2)` points (x, y) that are not of the object.
        grid: number of points along each side, without a prompt, at least 1.
        min_score: least overlap, in [0, 1], that the model predicts for a mask of the grid.
        cleanup: with a prompt, the object needs a piece of at least its ``min_size``; 1 keeps all pieces.

    Raises:
        ValueError: an argument has another shape or is out of its range, the weights do not fit the model, or the
            object of a prompt has no such piece.

    Example:
        ``segment(image, "sam", box=(30, 40, 200, 180), background=[(60, 70)])``
    """
    check_count("grid", grid)
    check_number("min_score", min_score, 0, 1)
    prompt = check_prompt(image, box, foreground, background)
    is_grid = prompt.box is None and not prompt.clicks
    inputs = _grid_inputs(image, grid) if is_grid else _prompt_inputs(prompt)
    network = load_pretrained("AutoModelForMaskGeneration", model, image.device)
    side, (height, width) = network.prompt_encoder.input_image_size, image.shape[1:]
    size = (side, side)
    if network.config.model_type == "sam":  # its input keeps the image's shape, in a corner of the square
        size = (round(height * side / max(height, width)), round(width * side / max(height, width)))
    square = F.pad(preprocess(image, size), (0, side - size[1], 0, side - size[0]))
    logits, scores = _predict_masks(network, square, inputs, torch.tensor([size[1] / width, size[0] / height]))
    if is_grid:
        logits, scores = logits.flatten(0, 1), scores.flatten()
        inner, outer = ((logits > offset).flatten(1).sum(dim=1) for offset in (_STABILITY_OFFSET, -_STABILITY_OFFSET))
        is_good = (scores >= min_score) & (inner >= _MIN_STABILITY * outer)
        logits, scores = logits[is_good], scores[is_good]
    else:
        objects, best = torch.arange(len(scores)), scores.argmax(dim=1)
        logits, scores = logits[objects, best], scores[objects, best]
    labels = torch.zeros(height, width, dtype=torch.int64, device=image.device)
    pixel_scores = torch.full((height, width), float("nan"), device=image.device)
    for label, mask in enumerate(suppress_duplicates(logits > 0, scores, _MAX_OVERLAP), start=1):
        large = F.interpolate(logits[mask][None, None], (side, side), mode="bilinear", align_corners=False)
        corner = large[..., : size[0], : size[1]]
        inside = F.interpolate(corner, (height, width), mode="bilinear", align_corners=False)[0, 0] > 0
        labels[inside] = label
        pixel_scores[inside] = scores[mask]
    if is_grid:
        return Prediction(labels, pixel_scores)
    min_size = cleanup.min_pixels(labels.numel())
    if not merge_small(labels.cpu().numpy(), min_size).any():
        raise InvalidArgument("min_size", f"smaller than the object, {int(labels.sum())} pixels in all", min_size)
    return Prediction(labels, pixel_scores, NAMES)


def _prompt_inputs(prompt: Prompt) -> dict[str, Tensor]:
    """Return the prompt of one object as the network's inputs, (1, 1, ...)."""
    if prompt.box is None and not prompt.foreground:
        raise InvalidArgument("foreground", "given where there is no box", "none")
    inputs: dict[str, Tensor] = {}
    if prompt.box is not None:
        inputs["input_boxes"] = torch.tensor([[prompt.box]])
    if prompt.clicks:
        inputs["input_points"] = torch.tensor([[[point for point, _ in prompt.clicks]]])
        inputs["input_labels"] = torch.tensor([[[label for _, label in prompt.clicks]]])
    return inputs


def _grid_inputs(image: Tensor, grid: int) -> dict[str, Tensor]:
    """Return the points of a grid as the network's inputs, (1, K, 1, ...)."""
    steps = (torch.arange(grid) + 0.5) / grid
    points = torch.cartesian_prod(steps * image.shape[1], steps * image.shape[2]).flip(-1)[None, :, None]
    return {"input_points": points, "input_labels": torch.ones(points.shape[:3], dtype=torch.int64)}


@torch.no_grad()
def _predict_masks(network: Any, square: Tensor, prompts: dict[str, Tensor], scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return logits (K, C, h, w) and predicted overlaps (K, C) of the masks of prompts (1, K, ...) in pixels."""
    embeddings = network.get_image_embeddings(square)
    logits, scores = [], []
    for start in range(0, next(iter(prompts.values())).shape[1], _BATCH):
        batch = {name: values[:, start : start + _BATCH] for name, values in prompts.items()}
        for name in ("input_boxes", "input_points"):
            if name in batch:  # the prompt encoder adds half a pixel
                batch[name] = (batch[name].unflatten(-1, (-1, 2)) * scale - 0.5).flatten(-2)
        is_ambiguous = "input_boxes" not in batch and batch["input_points"].shape[2] == 1
        batch = {name: values.to(square.device) for name, values in batch.items()}
        result = network(image_embeddings=embeddings, multimask_output=is_ambiguous, **batch)
        logits.append(result.pred_masks[0].float())
        scores.append(result.iou_scores[0].float())
    return torch.cat(logits), torch.cat(scores)


def suppress_duplicates(masks: Tensor, scores: Tensor, max_overlap: float) -> list[int]:
    """Return indices of masks (M, h, w), the largest first, without masks that overlap a better mask too much.

    Overlap is intersection over union. Of masks with equal scores (M,) the earlier is better. Of masks with equal
    areas the better comes last.
    """
    flat = masks.flatten(1).float()
    areas = flat.sum(dim=1)
    shared = flat @ flat.T
    is_duplicate = (shared > max_overlap * (areas[:, None] + areas[None] - shared)).tolist()
    indices: list[int] = []
    for mask in scores.argsort(descending=True, stable=True).tolist():
        if areas[mask] > 0 and not any(is_duplicate[mask][other] for other in indices):
            indices.append(mask)
    return sorted(reversed(indices), key=lambda mask: -float(areas[mask]))
