"""Any segmentation network in ONNX, and LSeg as an ONNX image encoder."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating, check_number, check_numbers, check_size
from kcgs.errors import InvalidArgument
from kcgs.segment.cleanup import Prediction
from kcgs.segment.networks import IMAGENET_MEAN, IMAGENET_STD, library_errors, predict_labels, preprocess
from kcgs.segment.registry import register

# largest distance from 1 of a sum of probabilities over the classes; half precision misses 1 by about 1e-3
_SUM_TOLERANCE = 1e-2
# least probability before the logarithm
_MIN_PROBABILITY = 1e-6
# temperature of CLIP, LSeg's text encoder: logits are cosine similarities divided by it
_TEMPERATURE = 0.07


@register("onnx")
def onnx(
    image: Tensor,
    *,
    model: str | os.PathLike[str],
    threshold: float = 0.5,
    size: tuple[int, int] | None = None,
    mean: Sequence[float] = IMAGENET_MEAN,
    std: Sequence[float] = IMAGENET_STD,
    names: Sequence[str] | None = None,
) -> Prediction:
    """Segment by a network in ONNX, run by onnxruntime on the CPU.

    The image is resized to the network's input (bilinear, antialiased) and normalised by ``mean`` and ``std``. The
    network's first output is resized to the image. Shape and values of the output determine its meaning:

    - integers, (1, h, w) or (1, 1, h, w): class numbers, without scores.
    - (1, C, h, w), C > 1: probabilities if they sum to 1, else logits; the largest wins, its softmax is the score.
    - (1, 1, h, w) or (1, h, w): saliency if all values are in [0, 1], stretched to this range as in U-2-Net's code;
      else logits. Pixels above ``threshold`` are foreground, label 1.

    Args:
        image: as `segment` takes it, any size.
        model: an ONNX file with one input (1, 3, h, w), float or half.
        threshold: of the foreground's score, in [0, 1], for one-channel outputs.
        size: (h, w) of the input if the network has no fixed size; None: the image's size.
        mean: three numbers, for images in [0, 1].
        std: three numbers above 0; 1 / 255 each for a network that reads images in [0, 255].
        names: names of the classes, class 0 first; for one-channel outputs two names, the background's first.

    Raises:
        TypeError, ValueError: an argument is out of its range, or ``model`` is no such network or does not run.

    Example:
        ``segment(image, "onnx", model="u2netp.onnx")`` separates the salient object from the rest (U-2-Net, Qin et al.,
        Pattern Recognition 2020).
    """
    check_number("threshold", threshold, 0, 1)
    raw = _run(image, model, size, mean, std)
    if not raw.is_floating_point():
        if len(raw) > 1:
            received = f"{len(raw)} channels of {raw.dtype}"
            raise InvalidArgument("model", "a network of labels in one channel, or of floating scores", received)
        labels = F.interpolate(raw[None].double(), image.shape[1:], mode="nearest-exact")[0, 0].long()
        return Prediction(labels, names=names)
    if len(raw) > 1:
        is_probability = raw.min() >= 0 and (raw.sum(dim=0) - 1).abs().max() < _SUM_TOLERANCE
        logits = raw.clamp(min=_MIN_PROBABILITY).log() if is_probability else raw
        _check_names(names, len(raw))
        return predict_labels(logits, image.shape[1:], names)
    _check_names(names, 2)
    return _predict_saliency(raw, image, threshold)._replace(names=names)


def saliency(
    image: Tensor, model: str | os.PathLike[str], threshold: float, mean: Sequence[float], std: Sequence[float]
) -> Prediction:
    """Segment as `onnx` does by a network with an output of one channel."""
    raw = _run(image, model, None, mean, std)
    if len(raw) != 1 or not raw.is_floating_point():
        raise ValueError(f"the output of {model} must be a saliency, (1, 1, h, w); got {tuple(raw.shape)}")
    return _predict_saliency(raw, image, threshold)


def _predict_saliency(raw: Tensor, image: Tensor, threshold: float) -> Prediction:
    """Return label 1 where a saliency, (1, h, w), is above a threshold: see `onnx`."""
    low, high = raw.aminmax()
    if low >= 0 and high <= 1:
        raw = ((raw - low) / (high - low).clamp(min=_MIN_PROBABILITY)).logit(_MIN_PROBABILITY)
    return predict_labels(raw, image.shape[1:], None, threshold)


@register("lseg")
def lseg(
    image: Tensor,
    *,
    model: str | os.PathLike[str],
    embeddings: str | os.PathLike[str] | NDArray[Any],
    size: tuple[int, int] | None = None,
    mean: Sequence[float] = (0.5, 0.5, 0.5),
    std: Sequence[float] = (0.5, 0.5, 0.5),
    names: Sequence[str] | None = None,
) -> Prediction:
    """Segment by language as LSeg does (Li et al., ICLR 2022): pixel features against text embeddings.

    The label of a pixel is the class with the largest cosine similarity. Its score is the softmax of the similarities
    divided by CLIP's temperature, 0.07.

    Args:
        image: as `segment` takes it, any size.
        model: LSeg's image encoder, an ONNX file from (1, 3, h, w) to features (1, D, h', w').
        embeddings: a CLIP text embedding for each class, (K, D): an .npy file or an array.
        size: as in the method "onnx", like ``mean`` and ``std``.
        mean: three numbers.
        std: three numbers above 0.
        names: of the K classes.

    Raises:
        TypeError, ValueError: as `onnx`; embeddings of another shape.

    Example:
        ``segment(image, "lseg", model="lseg.onnx", embeddings="dog-grass-other.npy")``
    """
    if isinstance(embeddings, str | os.PathLike):
        with library_errors(f"cannot read {os.fspath(embeddings)} as an .npy array"):
            embeddings = np.load(embeddings, allow_pickle=False)
    texts = check_floating("embeddings", torch.as_tensor(embeddings), dims=(2,)).float()
    _check_names(names, len(texts))
    features = _run(image, model, size, mean, std)
    if len(features) != texts.shape[1]:
        raise InvalidArgument("embeddings", f"shape (K, {len(features)})", tuple(texts.shape), verb="have")
    similarity = torch.einsum("dhw,kd->khw", F.normalize(features, dim=0), F.normalize(texts, dim=1))
    return predict_labels(similarity / _TEMPERATURE, image.shape[1:], names)


def _check_names(names: Sequence[str] | None, classes: int) -> None:
    if names is not None and len(names) != classes:
        raise InvalidArgument("names", f"{classes}, one for each class, class 0 first", len(names))


def _run(
    image: Tensor,
    model: str | os.PathLike[str],
    size: tuple[int, int] | None,
    mean: Sequence[float],
    std: Sequence[float],
) -> Tensor:
    """Run a network on (3, H, W) and return its first output, (C, h, w) floating or (1, h, w) int64."""
    import onnxruntime

    check_numbers("mean", mean, 3)
    check_numbers("std", std, 3, 0, above=True)
    with library_errors(f"cannot read {model} as an ONNX network"):
        session = onnxruntime.InferenceSession(os.fspath(model), providers=["CPUExecutionProvider"])
    entry = session.get_inputs()[0]
    sides = [side for side in entry.shape[2:] if isinstance(side, int)]
    height, width = check_size("size", size or (sides if len(sides) == 2 else image.shape[1:]))
    values = preprocess(image.cpu(), (height, width), mean, std).numpy()
    with library_errors(f"{model} does not run on {values.shape}"):
        values = values.astype(np.float16 if entry.type == "tensor(float16)" else np.float32)
        result = np.asarray(session.run(None, {entry.name: values})[0])
    if result.ndim not in (3, 4) or len(result) != 1 or not np.isfinite(result).all():
        raise ValueError(f"the output of {model} must be finite, (1, C, h, w) or (1, h, w); got {result.shape}")
    maps = torch.from_numpy(result.astype(np.float32 if result.dtype.kind == "f" else np.int64))
    return maps[0] if maps.ndim == 4 else maps
