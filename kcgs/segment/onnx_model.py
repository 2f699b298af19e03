"""Any segmentation network in ONNX, and LSeg as an ONNX image encoder."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Unpack

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_size
from kcgs.segment.base import check_segment_image
from kcgs.segment.cleanup import check_number
from kcgs.segment.names import check_names, read_names
from kcgs.segment.sources import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    CleanupOptions,
    Segmentation,
    check_share,
    cleanup_of,
    first_line,
    largest_map,
    normalized,
    register_scored,
    require,
)

Kind = Literal["auto", "logits", "probability", "label", "saliency"]
_KINDS = ("auto", "logits", "probability", "label", "saliency")
_DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_SUM_TOLERANCE = 1e-2  # Of probabilities over the classes; half precision leaves some 1e-3.


class Preprocessing(NamedTuple):
    """How an image becomes a network's input: resized, times ``scale``, less ``mean``, over ``std``."""

    size: tuple[int, int] | None
    mean: tuple[float, ...]
    std: tuple[float, ...]
    scale: float


@register_scored("onnx")
def onnx(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any,
    kind: Kind = "auto",
    output: int | str = 0,
    threshold: float = 0.5,
    size: tuple[int, int] | None = None,
    mean: Sequence[float] = IMAGENET_MEAN,
    std: Sequence[float] = IMAGENET_STD,
    scale: float = 1.0,
    names: Sequence[str] | str | os.PathLike[str] | None = None,
    **cleanup: Unpack[CleanupOptions],
) -> Segmentation:
    """Segment by a network in ONNX, run by onnxruntime on the CPU.

    The image is resized to the network's input (bilinear, antialiased), multiplied by ``scale``, less ``mean``,
    over ``std``; what comes out is resized to the image. Kinds of output, C classes:

    - "logits", (1, C, h, w): the largest wins, scored by its softmax; with C = 1 a sigmoid above ``threshold``.
    - "probability", (1, C, h, w): the largest wins and is the score; with C = 1 a value above ``threshold``.
    - "saliency", (1, 1, h, w): stretched to [0, 1] as U-2-Net's own code does, then above ``threshold``.
    - "label", (1, h, w) or (1, 1, h, w): class numbers; they have no scores.

    "auto" takes integers for labels, one channel within [0, 1] for saliency, several that are not negative
    and sum to 1 for probabilities, and the rest for logits.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1], any size.
        model: an ONNX file with one input (1, 3, h, w), or an ``onnxruntime.InferenceSession``.
        kind: what the output holds.
        output: the output's position or name.
        threshold: of one-channel outputs, in [0, 1].
        size: (h, w) of an input whose size is free; None: the image's own.
        mean: three numbers, in units of the scaled image.
        std: three numbers above 0, in units of the scaled image.
        scale: 255 for a network that takes [0, 255].
        names: of the classes, class 0 first, or a text file with one a line; of one-channel outputs two, the
            background's first.
        cleanup: ``min_size``, ``snap``, ``max_regions`` and ``connected`` of `Cleanup`.

    Returns:
        :math:`(H, W)` int64 with ids 0 to R - 1 by decreasing area; `segment_with_scores` adds :math:`(R,)`
        scores, the foreground's and one less it for the background, and each region's name where there are
        ``names``.

    Raises:
        FileNotFoundError: ``model`` does not exist.
        ImportError: onnxruntime is not installed.
        TypeError: an argument has another type.
        ValueError: an argument is out of its range, ``model`` is no such network or does not run, or its
            output is not of ``kind``.

    Example:
        ``segment(image, "onnx", model="u2netp.onnx")`` puts the salient object and the rest apart (U-2-Net,
        Qin et al., Pattern Recognition 2020).
    """
    pixels = torch.from_numpy(check_segment_image(image)).permute(2, 0, 1)
    rules = cleanup_of(cleanup)
    if kind not in _KINDS:
        raise ValueError(f"kind must be one of {', '.join(_KINDS)}; got {kind!r}")
    threshold, words = check_share("threshold", threshold), read_names(names)
    raw = run_network(pixels, model, output, check_preprocessing(size, mean, std, scale), "onnx")
    labels, scores = decode_output(raw, kind, threshold, (pixels.shape[1], pixels.shape[2]))
    if words is not None:
        _check_names(words, raw, labels, scored=scores is not None)
    return rules.apply(image.detach(), labels, scores, words)


@register_scored("lseg")
def lseg(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any,
    embeddings: str | os.PathLike[str] | NDArray[Any],
    output: int | str = 0,
    size: tuple[int, int] | None = None,
    mean: Sequence[float] = (0.5, 0.5, 0.5),
    std: Sequence[float] = (0.5, 0.5, 0.5),
    scale: float = 1.0,
    temperature: float = 0.07,
    names: Sequence[str] | str | os.PathLike[str] | None = None,
    **cleanup: Unpack[CleanupOptions],
) -> Segmentation:
    """Segment by language as LSeg does (Li et al., ICLR 2022): pixel features against text embeddings.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1], any size.
        model: LSeg's image encoder in ONNX, (1, 3, h, w) to features (1, D, h', w'), or a session.
        embeddings: an .npy file with one CLIP text embedding a class, (K, D), or that array.
        output: the output's position or name.
        size: (h, w) of an input whose size is free; None: the image's own.
        mean: three numbers, in units of the scaled image.
        std: three numbers above 0, in units of the scaled image.
        scale: 255 for a network that takes [0, 255].
        temperature: above 0; the score is the softmax of cosine similarities over it.
        names: of the classes, one an embedding, or a text file with one a line.
        cleanup: ``min_size``, ``snap``, ``max_regions`` and ``connected`` of `Cleanup`.

    Returns:
        :math:`(H, W)` int64, the class of largest cosine similarity, cleaned; ids 0 to R - 1 by decreasing
        area. `segment_with_scores` adds :math:`(R,)` scores, and each region's name where there are ``names``.

    Raises:
        FileNotFoundError: a file does not exist.
        ImportError: onnxruntime is not installed.
        TypeError: an argument has another type.
        ValueError: an argument is out of its range, a file cannot be read, or features and embeddings differ
            in length.

    Example:
        ``segment(image, "lseg", model="lseg.onnx", embeddings="dog-grass-other.npy")``
    """
    pixels = torch.from_numpy(check_segment_image(image)).permute(2, 0, 1)
    rules = cleanup_of(cleanup)
    check_number("temperature", temperature, positive=True)
    texts, words = _embeddings(embeddings), read_names(names)
    if words is not None:
        check_names(words, len(texts))
    features = run_network(pixels, model, output, check_preprocessing(size, mean, std, scale), "lseg")
    if features.ndim != 4 or features.shape[1] != texts.shape[1]:
        raise ValueError(
            f"features must have shape (1, {texts.shape[1]}, h, w) for embeddings {tuple(texts.shape)}; "
            f"got {tuple(features.shape)}"
        )
    similarity = torch.einsum("bdhw,kd->bkhw", F.normalize(features.float(), dim=1), F.normalize(texts, dim=1))
    classes, _, scores = largest_map(similarity / temperature, (pixels.shape[1], pixels.shape[2]))
    return rules.apply(image.detach(), classes, scores, words)


def check_preprocessing(
    size: tuple[int, int] | None, mean: Sequence[float], std: Sequence[float], scale: float
) -> Preprocessing:
    """Return checked options."""
    for name, values in (("mean", mean), ("std", std)):
        if not isinstance(values, Sequence) or not all(isinstance(value, int | float) for value in values):
            raise TypeError(f"{name} must be three numbers; got {values!r}")
        if len(values) != 3 or not all(math.isfinite(value) for value in values):
            raise ValueError(f"{name} must be three numbers; got {values!r}")
    if min(std) <= 0:
        raise ValueError(f"std must be above 0; got {std!r}")
    check_number("scale", scale, positive=True)
    return Preprocessing(None if size is None else check_size("size", size), tuple(mean), tuple(std), float(scale))


def run_network(
    pixels: Tensor, model: str | os.PathLike[str] | Any, output: int | str, how: Preprocessing, used_by: str
) -> Tensor:
    """Run a network on (3, H, W) and return one of its outputs."""
    session, name = _session(model, used_by)
    if len(session.get_inputs()) != 1:
        raise ValueError(f"{name} must have one input; got {[entry.name for entry in session.get_inputs()]}")
    entry = session.get_inputs()[0]
    if entry.type not in _DTYPES:
        raise ValueError(f"the input of {name} must be one of {', '.join(_DTYPES)}; got {entry.type}")
    height, width = _input_size(entry.shape, how.size, (pixels.shape[1], pixels.shape[2]), name)
    resized = F.interpolate(pixels[None], (height, width), mode="bilinear", align_corners=False, antialias=True)
    values = normalized(resized * how.scale, how.mean, how.std).numpy()
    if entry.type == "tensor(uint8)":
        values = np.rint(values).clip(0, 255)
    try:
        results = session.run([_output_name(session, output, name)], {entry.name: values.astype(_DTYPES[entry.type])})
    except ValueError:
        raise
    except Exception as error:  # onnxruntime's own exceptions share no base class.
        raise ValueError(f"{name} does not run on {values.shape}: {first_line(error)}") from error
    result = np.asarray(results[0])
    return torch.from_numpy(result.astype(np.float32 if result.dtype.kind == "f" else np.int64))


def decode_output(raw: Tensor, kind: Kind, threshold: float, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
    """Return labels and scores (H, W) from what a network put out."""
    if kind == "auto":
        kind = _told_kind(raw)
    if kind == "label":
        classes = raw.flatten(0, -3) if raw.ndim > 2 else raw[None]
        if len(classes) != 1 or (classes != classes.round()).any() or classes.min() < 0:
            raise ValueError(f"labels must be whole numbers (1, h, w) of at least 0; got shape {tuple(raw.shape)}")
        return F.interpolate(classes[None].double(), size, mode="nearest-exact")[0, 0].long(), None
    if raw.ndim == 3:
        raw = raw[:, None]
    if raw.ndim != 4 or raw.shape[0] != 1 or not raw.isfinite().all():
        raise ValueError(f"the output must be finite, of shape (1, C, h, w); got {tuple(raw.shape)}")
    if kind == "saliency":
        if raw.shape[1] != 1:
            raise ValueError(f"a saliency output must have one channel; got shape {tuple(raw.shape)}")
        raw = (raw - raw.min()) / (raw.max() - raw.min()).clamp(min=1e-12)
    classes, values, shares = largest_map(raw, size)
    if raw.shape[1] == 1:
        values = values.sigmoid() if kind == "logits" else values
        inside = values > threshold
        return inside.long(), torch.where(inside, values, 1 - values)
    return classes, shares if kind == "logits" else values


def _check_names(names: list[str], raw: Tensor, labels: Tensor, *, scored: bool) -> None:
    """Refuse names that do not go with the classes of a network's output."""
    if scored:
        channels = raw.shape[1] if raw.ndim == 4 else 1
        check_names(names, max(2, channels))
    elif int(labels.max()) >= len(names):
        raise ValueError(f"names must be at least {int(labels.max()) + 1}, one a class; got {len(names)}")


def _told_kind(raw: Tensor) -> Kind:
    if not raw.is_floating_point():
        return "label"
    within = bool(raw.min() >= 0) and bool(raw.max() <= 1)
    if raw.ndim == 3 or raw.shape[1] == 1:
        return "saliency" if within else "logits"
    sums = raw.sum(dim=1)
    return "probability" if within and bool((sums - 1).abs().max() < _SUM_TOLERANCE) else "logits"


def _session(model: Any, used_by: str) -> tuple[Any, str]:
    onnxruntime = require("onnxruntime", "onnxruntime", used_by)
    if isinstance(model, onnxruntime.InferenceSession):
        return model, "the network"
    path = Path(model)
    if not path.is_file():
        raise FileNotFoundError(f"no ONNX network at {path}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions share no base class.
        raise ValueError(f"cannot read {path} as an ONNX network: {first_line(error)}") from error
    return session, str(path)


def _input_size(
    shape: Sequence[object], asked: tuple[int, int] | None, own: tuple[int, int], name: str
) -> tuple[int, int]:
    fixed = [side if isinstance(side, int) and side > 0 else None for side in shape]
    if len(fixed) != 4 or fixed[0] not in (1, None) or fixed[1] not in (3, None):
        raise ValueError(f"the input of {name} must be (1, 3, h, w); got {list(shape)}")
    height, width = (given or wanted for given, wanted in zip(fixed[2:], asked or own, strict=True))
    if asked is not None and (height, width) != asked:
        raise ValueError(f"size must be the {height} x {width} that {name} is made for; got {asked}")
    return height, width


def _output_name(session: Any, output: int | str, name: str) -> str:
    names = [entry.name for entry in session.get_outputs()]
    if isinstance(output, int) and not isinstance(output, bool) and -len(names) <= output < len(names):
        return str(names[output])
    if output in names:
        return str(output)
    raise ValueError(f"output must be a position or one of the outputs {names} of {name}; got {output!r}")


def _embeddings(embeddings: str | os.PathLike[str] | NDArray[Any]) -> Tensor:
    if isinstance(embeddings, str | os.PathLike):
        if not Path(embeddings).is_file():
            raise FileNotFoundError(f"no text embeddings at {embeddings}")
        try:
            values = np.load(embeddings, allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"cannot read {embeddings} as an .npy array: {first_line(error)}") from error
    else:
        values = np.asarray(embeddings)
    if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or values.ndim != 2 or values.size == 0:
        raise ValueError(f"embeddings must be a floating array (K, D); got {getattr(values, 'shape', values)}")
    if not np.isfinite(values).all():
        raise ValueError("embeddings must be finite")
    return torch.from_numpy(values.astype(np.float32))
