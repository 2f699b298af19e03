"""Segment Anything: kornia's, and SAM 2 through transformers, prompted by points, boxes or a grid."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count, check_floating, check_integer, check_number
from kcgs.segment.networks import IMAGENET_MEAN, IMAGENET_STD, first_line, load_pretrained, preprocess
from kcgs.segment.registry import Prediction, register

_KORNIA_MODELS = ("vit_b", "vit_l", "vit_h", "mobile_sam")
_AT_ONCE = 16  # Prompts per pass.
_MAX_SIDE = 1024  # What the models see; masks of larger images are made at this size and enlarged.
_STABILITY_OFFSET = 1.0  # Of Segment Anything's own automatic generator.
_IOU_PIXELS = 1 << 16  # Of all masks, that are compared at a time.


class Prompts(NamedTuple):
    """A prompt in each row: points with their labels, or the corners of a box."""

    points: Tensor
    """:math:`(K, P, 2)` (x, y) in pixels."""
    labels: Tensor | None
    """:math:`(K, P)`: 1 in the object, 0 outside; None: the two points are the corners of a box."""


# From points and labels of K prompts to logits (K, C, H, W) and predicted overlaps (K, C) of masks.
_Predict = Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]


@register("sam")
def sam(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any = "vit_b",
    checkpoint: str | os.PathLike[str] | None = None,
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
    everything, and of its masks (three per point) those stay that the model scores at least ``min_score``, that hardly
    depend on the threshold, and that overlap no better one by more than ``max_overlap`` (intersection over union).
    Masks are painted from large to small, so that the smaller lies over the larger, of equal ones the better over the
    worse; each connected piece of what no mask covers is a region too.

    Args:
        image: as `segment` takes it, any size.
        model: "vit_b", "vit_l", "vit_h" or "mobile_sam" for Segment Anything by kornia, a ``SamConfig`` or a loaded
            ``Sam`` of ``kornia.models.sam``; else SAM 2 by transformers: a hub id such as
            "facebook/sam2.1-hiera-tiny", a local folder, or a loaded ``Sam2Model``.
        checkpoint: the weights of a kornia model, a file or URL; None: the released ones, downloaded once.
        boxes: :math:`(K, 4)` left, top, right, bottom in pixels; these three may be lists too.
        points: :math:`(K, 2)`, or :math:`(K, P, 2)` for K objects of P points each, (x, y) in pixels.
        point_labels: integers of the shape of ``points`` less its last dimension, 1 in the object and 0 outside; None:
            all 1.
        grid: points along each side where there are neither boxes nor points, at least 1.
        min_score: of the grid's masks, in [0, 1], against the overlap that the model predicts.
        min_stability: of the grid's masks, in [0, 1]: overlap of the mask at logits above 1 and above -1.
        max_overlap: in [0, 1].

    Returns:
        The label map that `segment` returns; `segment_with_scores` adds :math:`(R,)` scores, the predicted overlap of
        each mask, NaN for what no mask covers.

    Raises:
        FileNotFoundError: ``checkpoint``, or the folder that ``model`` is the path of, does not exist.
        TypeError: an argument has another type.
        ValueError: an argument has another shape or is out of its range, or the weights do not fit the model.

    Example:
        ``segment(image, "sam", model="vit_b", checkpoint="sam_vit_b_01ec64.pth")``
    """
    check_count("grid", grid)
    for name, value in (("min_score", min_score), ("min_stability", min_stability), ("max_overlap", max_overlap)):
        check_number(name, value, 0, 1)
    nobody_asks = boxes is None and points is None and point_labels is None
    prompts = _grid_prompts(image, grid) if nobody_asks else _check_prompts(image, boxes, points, point_labels)
    small, prompts = _shrunk(image, prompts)
    floors = (min_score, min_stability) if nobody_asks else None
    masks, scores = _predict_masks(_predictor(small, model, checkpoint), prompts, floors)
    kept = keep_apart(masks, scores, max_overlap)
    maps = torch.stack([part.double() for part in paint_masks(masks[kept], scores[kept])])
    labels, painted = F.interpolate(maps[None], image.shape[-2:], mode="nearest-exact")[0]
    return Prediction(labels.long(), painted)


def keep_apart(masks: Tensor, scores: Tensor, max_overlap: float) -> Tensor:
    """Return the indices of masks (M, H, W) that overlap no better kept one too much, best first.

    Overlap is intersection over union. Of equal scores (M,) the earlier is the better.
    """
    order = scores.argsort(descending=True, stable=True)
    flat = masks[order].flatten(1)
    shared = torch.zeros(len(flat), len(flat), device=masks.device)
    for start in range(0, flat.shape[1], _IOU_PIXELS):
        part = flat[:, start : start + _IOU_PIXELS].float()
        shared += part @ part.T
    areas = shared.diagonal()
    union = areas[:, None] + areas[None] - shared
    too_much = (shared > max_overlap * union).tolist()
    kept: list[int] = []
    for mask, area in enumerate(areas.tolist()):
        if area > 0 and not any(too_much[mask][other] for other in kept):
            kept.append(mask)
    return order[kept]


def paint_masks(masks: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Paint masks (M, H, W) from large to small, of equal ones the better by scores (M,) last.

    Returned are labels (H, W), 0 where there is no mask, and the score of each pixel's mask, NaN where none is.
    """
    labels = torch.zeros(masks.shape[1:], dtype=torch.int64, device=masks.device)
    painted = torch.full(masks.shape[1:], float("nan"), device=masks.device)
    areas = masks.flatten(1).sum(dim=1).tolist()
    values = scores.tolist()
    for index, mask in enumerate(sorted(range(len(masks)), key=lambda k: (-areas[k], values[k]))):
        labels[masks[mask]] = index + 1
        painted[masks[mask]] = values[mask]
    return labels, painted


def _shrunk(image: Tensor, prompts: Prompts) -> tuple[Tensor, Prompts]:
    """Return image and prompts at the size that masks are made at."""
    share = _MAX_SIDE / max(image.shape[1:])
    if share >= 1:
        return image, prompts
    size = [max(1, round(side * share)) for side in image.shape[1:]]
    small = F.interpolate(image[None], size, mode="bilinear", align_corners=False, antialias=True)[0]
    scale = image.new_tensor([size[1] / image.shape[2], size[0] / image.shape[1]])
    return small, prompts._replace(points=prompts.points * scale)


def _predict_masks(predict: _Predict, prompts: Prompts, floors: tuple[float, float] | None) -> tuple[Tensor, Tensor]:
    """Return masks (M, H, W) and scores (M,): the best of each prompt, or those above both floors."""
    masks, scores = [], []
    for start in range(0, len(prompts.points), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        logits, overlaps = predict(prompts.points[rows], None if prompts.labels is None else prompts.labels[rows])
        if floors is None:
            best = overlaps.argmax(dim=1)
            each = torch.arange(len(best), device=best.device)
            masks.append(logits[each, best] > 0)
            scores.append(overlaps[each, best])
        else:
            logits, overlaps = logits.flatten(0, 1), overlaps.flatten()
            inner = (logits > _STABILITY_OFFSET).flatten(1).sum(dim=1)
            outer = (logits > -_STABILITY_OFFSET).flatten(1).sum(dim=1)
            good = (overlaps >= floors[0]) & (inner >= floors[1] * outer) & (outer > 0)
            masks.append(logits[good] > 0)
            scores.append(overlaps[good])
    return torch.cat(masks), torch.cat(scores)


def _predictor(image: Tensor, model: Any, checkpoint: str | os.PathLike[str] | None) -> _Predict:
    """Return what predicts masks of an image by prompts."""
    is_kornia = model in _KORNIA_MODELS if isinstance(model, str) else type(model).__module__.startswith("kornia.")
    if is_kornia:
        return _kornia_predictor(image, model, checkpoint)
    if checkpoint is not None:
        raise ValueError(f"checkpoint goes with {', '.join(_KORNIA_MODELS)} or a SamConfig; got it with {model!r}")
    return _sam2_predictor(image, model)


def _kornia_predictor(image: Tensor, model: Any, checkpoint: str | os.PathLike[str] | None) -> _Predict:
    from kornia.contrib.visual_prompter import VisualPrompter
    from kornia.models.sam.model import Sam, SamConfig

    config = SamConfig(model) if isinstance(model, str) else model
    if isinstance(model, Sam):
        if checkpoint is not None:
            raise ValueError(f"checkpoint must be None with a loaded Sam; got {checkpoint!r}")
        config = SamConfig(encoder_embed_dim=8, encoder_depth=1, encoder_num_heads=1, encoder_global_attn_indexes=())
    elif checkpoint is None and config.checkpoint is None and config.model_type is None:
        raise ValueError("checkpoint must be given for a SamConfig of one's own; got None")
    source = os.fspath(checkpoint if checkpoint is not None else config.checkpoint or "")
    if source and "://" not in source and not Path(source).expanduser().is_file():
        raise FileNotFoundError(f"no checkpoint at {source}")
    fields = {**vars(config), "checkpoint": source or None, "pretrained": not (source or isinstance(model, Sam))}
    try:
        prompter = VisualPrompter(SamConfig(**fields), device=image.device)
    except Exception as error:  # Whatever a damaged file, other weights or a missing network raises.
        name = source or f"the released weights of {config.model_type!r}"
        # torch's own words advise to run whatever code is in the file
        why = "it is no file of weights" if isinstance(error, UnpicklingError) else first_line(error)
        raise ValueError(f"cannot load {name} as Segment Anything {model!r}: {why}") from error
    if isinstance(model, Sam):
        prompter.model = model.to(image.device)
    prompter.model.eval()
    prompter.set_image(image)

    def predict(points: Tensor, labels: Tensor | None) -> tuple[Tensor, Tensor]:
        if labels is None:
            result = prompter.predict(boxes=points.flatten(1), multimask_output=False)
        else:  # kornia counts pixel centres in whole numbers; one point alone is ambiguous and gets three masks.
            result = prompter.predict(points - 0.5, labels, multimask_output=points.shape[1] == 1)
        return torch.as_tensor(result._original_res_logits), result.scores

    return predict


def _sam2_predictor(image: Tensor, model: Any) -> _Predict:
    network = load_pretrained("Sam2Model", model, image.device)
    side, size = network.prompt_encoder.input_image_size, (image.shape[1], image.shape[2])
    scale = image.new_tensor([side / size[1], side / size[0]])
    shown = preprocess(image, (side, side), IMAGENET_MEAN, IMAGENET_STD)
    with torch.no_grad():
        embeddings = list(network.get_image_embeddings(shown))

    @torch.no_grad()
    def predict(points: Tensor, labels: Tensor | None) -> tuple[Tensor, Tensor]:
        scaled = points * scale - 0.5  # The prompt encoder adds half a pixel of its own.
        prompt = {"input_points": scaled[None], "input_labels": None if labels is None else labels[None]}
        if labels is None:
            prompt = {"input_boxes": scaled.reshape(1, -1, 4)}
        is_one_point = labels is not None and points.shape[1] == 1
        result = network(image_embeddings=embeddings, multimask_output=is_one_point, **prompt)
        logits = F.interpolate(result.pred_masks[0].float(), size, mode="bilinear", align_corners=False)
        return logits, result.iou_scores[0].float()

    return predict


def _grid_prompts(image: Tensor, grid: int) -> Prompts:
    steps = (torch.arange(grid, device=image.device) + 0.5) / grid
    points = torch.cartesian_prod(steps * image.shape[1], steps * image.shape[2]).flip(-1)[:, None]
    return Prompts(points, points.new_ones(points.shape[:2], dtype=torch.int64))


def _check_prompts(image: Tensor, boxes: Any, points: Any, point_labels: Any) -> Prompts:
    if boxes is not None and points is not None:
        raise ValueError("boxes and points must not both be given")
    if point_labels is not None and points is None:
        raise ValueError("point_labels must come with points")
    if boxes is not None:
        boxes = check_floating("boxes", _as_tensor("boxes", boxes, torch.float32), last=4, dims=(2,)).to(image)
        if not len(boxes) or not (boxes[:, :2] < boxes[:, 2:]).all():
            raise ValueError(f"boxes must be left, top, right, bottom with left < right, top < bottom; got {boxes}")
        return Prompts(boxes.reshape(-1, 2, 2), None)
    points = check_floating("points", _as_tensor("points", points, torch.float32), last=2, dims=(2, 3)).to(image)
    if points.numel() == 0:
        raise ValueError(f"points must hold at least one point; got shape {tuple(points.shape)}")
    if point_labels is None:
        point_labels = torch.ones(points.shape[:-1], dtype=torch.int64)
    labels = check_integer("point_labels", _as_tensor("point_labels", point_labels)).long().to(image.device)
    if labels.shape != points.shape[:-1] or not ((labels == 0) | (labels == 1)).all():
        raise ValueError(f"point_labels must be 0 or 1, of shape {tuple(points.shape[:-1])}; got {labels}")
    return Prompts(points, labels) if points.ndim == 3 else Prompts(points[:, None], labels[:, None])


def _as_tensor(name: str, values: Any, dtype: torch.dtype | None = None) -> Tensor:
    """Return what may be a list, as from the command line, as a tensor."""
    if isinstance(values, Tensor):
        return values
    try:
        return torch.tensor(values, dtype=dtype)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be a tensor, or lists of numbers of one length; got {values!r}") from error
