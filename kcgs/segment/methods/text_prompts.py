"""Regions named by words: CLIPSeg."""

import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs.segment.networks import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    first_line,
    is_offline,
    largest_map,
    load_pretrained,
    preprocess,
)
from kcgs.segment.registry import Prediction, register

BACKGROUND = "background"  # What is no prompt's is called so.


@register("text")
def text(
    image: Tensor,
    *,
    prompts: Sequence[str],
    model: str | os.PathLike[str] | Any = "CIDAS/clipseg-rd64-refined",
    tokenizer: Any = None,
    threshold: float | None = None,
    side: int = 352,
) -> Prediction:
    """Segment by words, through CLIPSeg (Lüddecke and Ecker, CVPR 2022).

    Every pixel goes to the prompt with the largest logit; its score is the softmax over the prompts. With a
    ``threshold``, a pixel goes to a prompt where the best one's sigmoid is above it, else to the background; scores
    are then that sigmoid, and one less it in the background.

    Args:
        image: as `segment` takes it, any size.
        prompts: what to look for, such as ``["a dog", "grass"]``; at least one, and without a
            ``threshold`` at least two.
        model: a hub id, a local folder or a loaded ``CLIPSegForImageSegmentation``.
        tokenizer: of a loaded model; None: the one beside ``model``.
        threshold: of the foreground's score, in [0, 1]; None: there is no background.
        side: of the square that the model sees, in pixels, at least 1; 352 is what it was trained with.

    Returns:
        The label map that `segment` returns; `segment_with_scores` adds :math:`(R,)` scores, and names: each region's
        prompt, or "background".

    Raises:
        FileNotFoundError: ``model`` is the path of a folder that is not there.
        TypeError, ValueError: as `segment`; an argument is out of its range, or ``model`` cannot be loaded.

    Example:
        ``segment(image, "text", prompts=["a cat", "a sofa", "the wall"])``
    """
    words = _check_prompts(prompts, threshold)
    check_count("side", side)
    network = load_pretrained("CLIPSegForImageSegmentation", model, image.device)
    tokens = _tokens(network, model, tokenizer, words, image.device)
    shown = preprocess(image, (side, side), IMAGENET_MEAN, IMAGENET_STD).expand(len(words), -1, -1, -1)
    with torch.no_grad():
        logits = network(pixel_values=shown, **tokens).logits.float()
    logits = logits.reshape(1, len(words), *logits.shape[-2:])
    best, values, shares = largest_map(logits, (image.shape[1], image.shape[2]))
    if threshold is None:
        return Prediction(best, shares, words)
    probability = values.sigmoid()
    inside = probability > threshold
    scores = torch.where(inside, probability, 1 - probability)
    return Prediction(torch.where(inside, best + 1, 0), scores, [BACKGROUND, *words])


def _check_prompts(prompts: Sequence[str], threshold: float | None) -> list[str]:
    if isinstance(prompts, str) or not all(isinstance(prompt, str) for prompt in prompts):
        raise TypeError(f"prompts must be a list of strings; got {prompts!r}")
    if threshold is not None:
        check_number("threshold", threshold, 0, 1)
    fewest = 1 if threshold is not None else 2
    if len(prompts) < fewest or not all(prompt.split() for prompt in prompts):
        raise ValueError(
            f"prompts must be at least {fewest} non-empty strings, 2 where threshold is None; got {list(prompts)!r}"
        )
    return list(prompts)


def _tokens(network: Any, model: Any, tokenizer: Any, words: list[str], device: torch.device) -> dict[str, Tensor]:
    """Return the prompts as the model reads them, cut to the length it takes."""
    if tokenizer is None:
        if isinstance(model, torch.nn.Module):
            raise ValueError("tokenizer must be given with a loaded model; got None")
        from transformers import AutoTokenizer

        try:
            tokenizer = AutoTokenizer.from_pretrained(str(model), local_files_only=is_offline(str(model)))
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
