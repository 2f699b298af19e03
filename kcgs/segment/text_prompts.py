"""Regions named by words: CLIPSeg."""

import os
from collections.abc import Sequence
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
    check_share,
    cleanup_of,
    first_line,
    largest_map,
    load_pretrained,
    normalized,
    register_scored,
    require,
)

BACKGROUND = "background"  # What is no prompt's is called so.


@register_scored("text")
def text(
    image: Tensor,
    *,
    prompts: Sequence[str],
    model: str | os.PathLike[str] | Any = "CIDAS/clipseg-rd64-refined",
    tokenizer: Any = None,
    background: float | None = None,
    size: int = 352,
    **cleanup: Unpack[CleanupOptions],
) -> Segmentation:
    """Segment by words, through CLIPSeg (Lüddecke and Ecker, CVPR 2022).

    Every pixel goes to the prompt with the largest logit; its score is the softmax over the prompts. With
    ``background``, a pixel goes to no prompt where the best one's sigmoid is below it; scores are then that
    sigmoid, and one less it in the background.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1], any size.
        prompts: what to look for, such as ``["a dog", "grass"]``; at least one, and with ``background=None``
            at least two.
        model: a hub id, a local folder or a loaded ``CLIPSegForImageSegmentation``.
        tokenizer: of a loaded model; None: the one beside ``model``.
        background: in [0, 1]; None: there is none.
        size: pixels of the square that the model sees, at least 1; 352 is what it was trained with.
        cleanup: ``min_size``, ``snap``, ``max_regions`` and ``connected`` of `Cleanup`.

    Returns:
        :math:`(H, W)` int64 with ids 0 to R - 1 by decreasing area; `segment_with_scores` adds :math:`(R,)`
        scores, and names: each region's prompt, or "background".

    Raises:
        FileNotFoundError: ``model`` is the path of a folder that is not there.
        ImportError: transformers is not installed.
        TypeError: an argument has another type.
        ValueError: an argument is out of its range, or ``model`` cannot be loaded.

    Example:
        ``segment(image, "text", prompts=["a cat", "a sofa", "the wall"])``
    """
    pixels = torch.from_numpy(check_segment_image(image)).permute(2, 0, 1).to(image.device)
    rules = cleanup_of(cleanup)
    words = _check_prompts(prompts, background)
    check_count("size", size)
    network = load_pretrained("CLIPSegForImageSegmentation", model, "text", pixels.device)
    tokens = _tokens(network, model, tokenizer, words, pixels.device)
    shown = F.interpolate(pixels[None], (size, size), mode="bilinear", align_corners=False, antialias=True)
    shown = normalized(shown, IMAGENET_MEAN, IMAGENET_STD).expand(len(words), -1, -1, -1)
    with torch.no_grad():
        logits = network(pixel_values=shown, **tokens).logits.float()
    logits = logits.reshape(1, len(words), *logits.shape[-2:])
    best, values, shares = largest_map(logits, (pixels.shape[1], pixels.shape[2]))
    if background is None:
        return rules.apply(image.detach(), best, shares, words)
    sure = values.sigmoid()
    inside = sure >= background
    scores = torch.where(inside, sure, 1 - sure)
    return rules.apply(image.detach(), torch.where(inside, best + 1, 0), scores, [BACKGROUND, *words])


def _check_prompts(prompts: Sequence[str], background: float | None) -> list[str]:
    if isinstance(prompts, str) or not all(isinstance(prompt, str) for prompt in prompts):
        raise TypeError(f"prompts must be a list of strings; got {prompts!r}")
    if background is not None:
        check_share("background", background)
    fewest = 1 if background is not None else 2
    if len(prompts) < fewest or not all(prompt.strip() for prompt in prompts):
        raise ValueError(
            f"prompts must be at least {fewest} non-empty strings, 2 where background is None; got {list(prompts)!r}"
        )
    return list(prompts)


def _tokens(network: Any, model: Any, tokenizer: Any, words: list[str], device: torch.device) -> dict[str, Tensor]:
    """Return the prompts as the model reads them, cut to the length it takes."""
    if tokenizer is None:
        if isinstance(model, torch.nn.Module):
            raise ValueError("tokenizer must be given with a loaded model; got None")
        transformers = require("transformers", "'kcgs[segment]'", "text")
        try:
            tokenizer = transformers.AutoTokenizer.from_pretrained(str(model))
        except Exception as error:  # Whatever a damaged file or a missing network raises.
            raise ValueError(f"cannot load the tokenizer of {str(model)!r}: {first_line(error)}") from error
    longest = network.config.text_config.max_position_embeddings
    found = tokenizer(words, padding=True, truncation=True, max_length=longest, return_tensors="pt")
    # A folder without its vocabulary gives a tokenizer that knows no word, and no error.
    special = set(tokenizer.all_special_ids)
    for prompt, ids in zip(words, found["input_ids"].tolist(), strict=True):
        if special.issuperset(ids):
            raise ValueError(f"the tokenizer of {str(model)!r} knows nothing of the prompt {prompt!r}")
    return {name: found[name].to(device) for name in ("input_ids", "attention_mask")}
