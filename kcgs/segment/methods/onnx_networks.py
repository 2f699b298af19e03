"""Any segmentation network in ONNX, and LSeg as an ONNX image encoder."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating, check_number, check_numbers, check_size
from kcgs.segment.networks import IMAGENET_MEAN, IMAGENET_STD, first_line, largest_map, preprocess
from kcgs.segment.registry import Prediction, register

Kind = Literal["auto", "logits", "probability", "label", "saliency"]
_DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_SUM_TOLERANCE = 1e-2  # Of probabilities over the classes; half precision leaves some 1e-3.


@register("onnx")
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
    max_value: float = 1.0,
    names: Sequence[str] | str | os.PathLike[str] | None = None,
) -> Prediction:
    """Segment by a network in ONNX, run by onnxruntime on the CPU.

    The image is resized to the network's input (bilinear, antialiased), multiplied by ``max_value``, less ``mean``,
    over ``std``; what comes out is resized to the image. Kinds of output, C classes:

    - "logits", (1, C, h, w): the largest wins, scored by its softmax; with C = 1 a sigmoid above ``threshold``.
    - "probability", (1, C, h, w): the largest wins and is the score; with C = 1 a value above ``threshold``.
    - "saliency", (1, 1, h, w): stretched to [0, 1] as U-2-Net's own code does, then above ``threshold``.
    - "label", (1, h, w) or (1, 1, h, w): class numbers; they have no scores.

    "auto" takes integers for labels, one channel within [0, 1] for saliency, several that are not negative and sum to 1
    for probabilities, and the rest for logits.

    Args:
        image: as `segment` takes it, any size.
        model: an ONNX file with one input (1, 3, h, w), or an ``onnxruntime.InferenceSession``.
        kind: what the output holds.
        output: the output's position or name.
        threshold: of the foreground's score, in [0, 1], for one-channel outputs.
        size: (h, w) of an input whose size is free; None: the image's own.
        mean: three numbers, in the network's units.
        std: three numbers above 0, in the network's units.
        max_value: what the network takes for white: 255 where it takes [0, 255].
        names: of the classes, class 0 first, or a text file with one on each line; of one-channel outputs two, the
            background's first.

    Returns:
        The label map that `segment` returns; `segment_with_scores` adds :math:`(R,)` scores, the foreground's and one
        less it for the background, and each region's name where there are ``names``.

    Raises:
        FileNotFoundError: ``model`` does not exist.
        TypeError, ValueError: as `segment`; an argument is out of its range, ``model`` is no such network or does not
            run, or its output is not of ``kind``.

    Example:
        ``segment(image, "onnx", model="u2netp.onnx")`` puts the salient object and the rest apart (U-2-Net,
        Qin et al., Pattern Recognition 2020).
    """
    if kind not in get_args(Kind):
        raise ValueError(f"kind must be one of {', '.join(get_args(Kind))}; got {kind!r}")
    check_number("threshold", threshold, 0, 1)
    words = read_names(names)
    raw = _run(image.cpu(), model, output, size, mean, std, max_value)
    labels, scores = decode_output(raw, kind, threshold, (image.shape[1], image.shape[2]))
    if words is not None and scores is None and int(labels.max()) >= len(words):
        raise ValueError(f"names must be at least {int(labels.max()) + 1}, one for each class; got {len(words)}")
    if words is not None and scores is not None:
        _check_names(words, max(2, raw.shape[1] if raw.ndim == 4 else 1))
    return Prediction(labels, scores, words)


@register("lseg")
def lseg(
    image: Tensor,
    *,
    model: str | os.PathLike[str] | Any,
    embeddings: str | os.PathLike[str] | NDArray[Any],
    output: int | str = 0,
    size: tuple[int, int] | None = None,
    mean: Sequence[float] = (0.5, 0.5, 0.5),
    std: Sequence[float] = (0.5, 0.5, 0.5),
    max_value: float = 1.0,
    temperature: float = 0.07,
    names: Sequence[str] | str | os.PathLike[str] | None = None,
) -> Prediction:
    """Segment by language as LSeg does (Li et al., ICLR 2022): pixel features against text embeddings.

    Arguments, result and errors are those of `onnx`, but for these. ``model`` is LSeg's image encoder, (1, 3, h, w) to
    features (1, D, h', w'). ``embeddings`` is an .npy file with a CLIP text embedding for each class, (K, D), or that
    array; ``names`` has as many. The largest cosine similarity wins; its score is the softmax of the similarities over
    ``temperature``, above 0.

    Example:
        ``segment(image, "lseg", model="lseg.onnx", embeddings="dog-grass-other.npy")``
    """
    check_number("temperature", temperature, 0, above=True)
    texts, words = _embeddings(embeddings), read_names(names)
    if words is not None:
        _check_names(words, len(texts))
    features = _run(image.cpu(), model, output, size, mean, std, max_value)
    if features.ndim != 4 or features.shape[1] != texts.shape[1]:
        raise ValueError(
            f"features must have shape (1, {texts.shape[1]}, h, w) for embeddings {tuple(texts.shape)}; "
            f"got {tuple(features.shape)}"
        )
    similarity = torch.einsum("bdhw,kd->bkhw", F.normalize(features.float(), dim=1), F.normalize(texts, dim=1))
    classes, _, scores = largest_map(similarity / temperature, (image.shape[1], image.shape[2]))
    return Prediction(classes, scores, words)


def read_names(names: Sequence[str] | str | os.PathLike[str] | None) -> list[str] | None:
    """Return names of classes, class 0 first, from a list or a text file (UTF-8) with one on each line."""
    if names is None:
        return None
    if isinstance(names, str | os.PathLike):
        path = Path(names)
        if not path.is_file():
            raise FileNotFoundError(f"no names of classes at {path}")
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(f"cannot read {path} as UTF-8 text with a name on each line") from error
        # An empty line within counts: the numbers of the classes are those of the lines.
        names = [" ".join(line.split()) for line in "\n".join(lines).rstrip().split("\n")]
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"names must be a list of strings, or a text file with one on each line; got {names!r}")
    if not any(names):
        raise ValueError("names must have at least one name; got none")
    return list(names)


def _check_names(names: Sequence[str], classes: int) -> None:
    if len(names) != classes:
        raise ValueError(f"names must be {classes}, one for each class, class 0 first; got {len(names)}")


def _run(
    image: Tensor,
    model: str | os.PathLike[str] | Any,
    output: int | str,
    size: tuple[int, int] | None,
    mean: Sequence[float],
    std: Sequence[float],
    max_value: float,
) -> Tensor:
    """Run a network on (3, H, W) and return one of its outputs."""
    check_numbers("mean", mean, 3)
    check_numbers("std", std, 3, 0, above=True)
    check_number("max_value", max_value, 0, above=True)
    asked = None if size is None else check_size("size", size)
    session, name = _session(model)
    if len(session.get_inputs()) != 1:
        raise ValueError(f"{name} must have one input; got {[entry.name for entry in session.get_inputs()]}")
    entry = session.get_inputs()[0]
    if entry.type not in _DTYPES:
        raise ValueError(f"the input of {name} must be one of {', '.join(_DTYPES)}; got {entry.type}")
    seen = _input_size(entry.shape, asked, (image.shape[1], image.shape[2]), name)
    values = preprocess(image, seen, mean, std, max_value).numpy()
    if entry.type == "tensor(uint8)":
        values = np.rint(values).clip(0, 255)
    wanted = _output_name(session, output, name)
    try:
        results = session.run([wanted], {entry.name: values.astype(_DTYPES[entry.type])})
    except Exception as error:  # onnxruntime's own exceptions share no base class.
        raise ValueError(f"{name} does not run on {values.shape}: {first_line(error)}") from error
    result = np.asarray(results[0])
    return torch.from_numpy(result.astype(np.float32 if result.dtype.kind == "f" else np.int64))


def decode_output(raw: Tensor, kind: Kind, threshold: float, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
    """Return labels and scores (H, W) from what a network put out."""
    if kind == "auto":
        kind = _guess_kind(raw)
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


def _guess_kind(raw: Tensor) -> Kind:
    if not raw.is_floating_point():
        return "label"
    within = bool(raw.min() >= 0) and bool(raw.max() <= 1)
    if raw.ndim == 3 or raw.shape[1] == 1:
        return "saliency" if within else "logits"
    sums = raw.sum(dim=1)
    return "probability" if within and bool((sums - 1).abs().max() < _SUM_TOLERANCE) else "logits"


def _session(model: Any) -> tuple[Any, str]:
    import onnxruntime

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
    shape: Sequence[object], asked: tuple[int, int] | None, image_size: tuple[int, int], name: str
) -> tuple[int, int]:
    fixed = [side if isinstance(side, int) and side > 0 else None for side in shape]
    if len(fixed) != 4 or fixed[0] not in (1, None) or fixed[1] not in (3, None):
        raise ValueError(f"the input of {name} must be (1, 3, h, w); got {list(shape)}")
    height, width = (given or wanted for given, wanted in zip(fixed[2:], asked or image_size, strict=True))
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
    return check_floating("embeddings", torch.from_numpy(values.astype(np.float32)))
