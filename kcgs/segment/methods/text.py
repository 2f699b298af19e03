"""Regions named by words: CLIPSeg."""

import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.segment.cleanup import Prediction
from kcgs.segment.networks import library_errors, load_pretrained, predict_labels, preprocess
from kcgs.segment.registry import register

# sides in pixels of the images that CLIPSeg's decoder is trained on
_SIDE = 352


@register("text")
def text(
    image: Tensor,
    *,
    prompts: Sequence[str],
    model: str | os.PathLike[str] | Any = "CIDAS/clipseg-rd64-refined",
    threshold: float | None = None,
) -> Prediction:
    """Segment by words, through CLIPSeg (Lüddecke and Ecker, CVPR 2022).

    Every pixel goes to the prompt with the largest logit; its score is the softmax over the prompts. With a
    ``threshold``, a pixel is background if its largest sigmoid is at most the threshold. The score is then this
    sigmoid, or 1 minus it in the background. Names of regions are prompts, or "background".

    Args:
        image: as `segment` takes it, any size.
        prompts: what to look for, such as ``["a dog", "grass"]``; at least one, and without a
            ``threshold`` at least two.
        model: a hub id, a local folder or a loaded ``CLIPSegForImageSegmentation``; its tokenizer has the same source.
        threshold: of the foreground's score, in [0, 1]; None: there is no background.

    Raises:
        TypeError, ValueError: an argument is out of its range, or ``model`` cannot be loaded.

    Example:
        ``segment(image, "text", prompts=["a cat", "a sofa", "the wall"])``
    """
    if isinstance(prompts, str) or not all(isinstance(prompt, str) for prompt in prompts):
        raise InvalidArgumentType("prompts", "a list of strings", repr(prompts))
    if threshold is not None:
        check_number("threshold", threshold, 0, 1)
    if len(prompts) < (2 if threshold is None else 1):
        raise InvalidArgument("prompts", "at least 2, or 1 with a threshold", repr(list(prompts)))
    network = load_pretrained("CLIPSegForImageSegmentation", model, image.device)
    with library_errors(f"cannot load the tokenizer of {network.name_or_path!r}"):
        from transformers import AutoTokenizer

        tokenizer = AutoTokenizer.from_pretrained(network.name_or_path)
        tokens = tokenizer(list(prompts), padding=True, truncation=True, return_tensors="pt").to(image.device)
    shown = preprocess(image, (_SIDE, _SIDE)).expand(len(prompts), -1, -1, -1)
    with torch.no_grad():
        logits = network(
            pixel_values=shown, input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
        ).logits
    return predict_labels(logits.reshape(len(prompts), *logits.shape[-2:]), image.shape[1:], prompts, threshold)
