"""The main object of a photo, by a network that needs no prompt."""

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs._check import check_number
from kcgs.errors import InvalidArgument
from kcgs.segment.cleanup import Cleanup, Prediction, merge_small
from kcgs.segment.cutting import NAMES, correct_mask
from kcgs.segment.methods.onnx import saliency
from kcgs.segment.networks import IMAGENET_MEAN, IMAGENET_STD
from kcgs.segment.prompts import Points, check_prompt, window_of
from kcgs.segment.registry import register

_RELEASE = "https://github.com/danielgatis/rembg/releases/download/v0.0.0"
# where rembg keeps its weights, too
_FOLDER_VARIABLE = "U2NET_HOME"
_FOLDER = "~/.u2net"

Triple = tuple[float, float, float]


class _Weights(NamedTuple):
    """A network's file on the web, and the mean and deviation of its images in [0, 1]."""

    file: str
    md5: str
    mean: Triple = IMAGENET_MEAN
    std: Triple = IMAGENET_STD


_WEIGHTS = {
    "isnet-general-use": _Weights(
        "isnet-general-use.onnx", "fc16ebd8b0c10d971d3513d564d01e29", (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)
    ),
    "birefnet-general": _Weights("BiRefNet-general-epoch_244.onnx", "7a35a0141cbbc80de11d9c9a28f52697"),
    "u2netp": _Weights("u2netp.onnx", "8e83ca70e441ab06c318d82300c84806"),
}
_DEFAULT = "isnet-general-use"
# what the network sees around a box, in sides of the box: with less it takes parts for the whole
_VIEW = 0.8
# of what the network sees: smaller specks and holes of its mask vanish; those that are larger are parts, such as spokes
_LEAST_PIECE = 2e-4


@register("object", Cleanup(min_size=1, connected=False))
def find_object(
    image: Tensor,
    *,
    model: str | os.PathLike[str] = _DEFAULT,
    threshold: float = 0.5,
    pieces: bool = False,
    box: Points | None = None,
    foreground: Points | None = None,
    background: Points | None = None,
) -> Prediction:
    """Separate the main object of a photo from the rest.

    The networks are ISNet (Qin et al., "Highly Accurate Dichotomous Image Segmentation", ECCV 2022), BiRefNet (Zheng et
    al., CAAI AIR 2024) and U-2-Net's small one, as the project rembg publishes them in ONNX: 179 MB, 973 MB and 4.6 MB.
    They are downloaded once, into ~/.u2net or the folder U2NET_HOME, where rembg keeps them, too. With a box the
    network sees the box and what is around it, and the object is what it finds in the box. Clicks correct the mask
    as they do for the method "grabcut". The names of regions are "object" and "background".

    Args:
        image: as `segment` takes it, any size.
        model: isnet-general-use, birefnet-general, u2netp, or an ONNX file: by its name one of theirs, else ISNet's;
            the method "onnx" takes other networks.
        threshold: of the object's score, in [0, 1].
        pieces: every connected piece of the object is a region of its own; False: all are one.
        box: left, top, right, bottom in pixels, around the object that is meant; None: the whole image.
        foreground: :math:`(P, 2)` points (x, y) that the network missed, in pixels, in the box.
        background: :math:`(P, 2)` points (x, y) of what it took by mistake.

    Raises:
        ValueError: no such model, weights that cannot be had, or a file that is no such network; a box without pixels
            of the image, points outside of it or of the box; no object is found.
        ImportError: OpenCV is not installed, which clicks need.

    Warns:
        UserWarning: a click that the mask does not follow.

    Example:
        ``segment(image, "object")``
    """
    check_number("threshold", threshold, 0, 1)
    prompt = check_prompt(image, box, foreground, background)
    path, weights = _find_weights(model)
    height, width = image.shape[1:]
    box = prompt.box or (0.0, 0.0, float(width), float(height))
    view, inside = window_of(box, _VIEW, height, width), window_of(box, 0.0, height, width)
    seen = saliency(image[:, *view], path, threshold, weights.mean, weights.std)
    labels, scores = torch.zeros(height, width, dtype=torch.int64), torch.full((height, width), torch.nan)
    labels[view], scores[view] = seen.labels, seen.scores
    mask = torch.zeros_like(labels)
    mask[inside] = labels[inside]
    mask = torch.from_numpy(merge_small(mask.numpy(), max(1, round(_LEAST_PIECE * labels[view].numel()))))
    prediction = correct_mask(image, mask > 0, prompt)
    scores[prediction.labels != labels] = torch.nan  # these are the network's, of the other label
    prediction = prediction._replace(scores=scores)
    return _label_pieces(prediction) if pieces else prediction


def _label_pieces(prediction: Prediction) -> Prediction:
    """Make every connected piece of the object a label of its own."""
    from scipy import ndimage

    labels, count = ndimage.label(prediction.labels.numpy())
    return prediction._replace(labels=labels, names=NAMES[:1] + NAMES[1:] * count)


def _find_weights(model: str | os.PathLike[str]) -> tuple[Path, _Weights]:
    """Return the file of a network and its normalisation; download it where it is not there."""
    if (weights := _WEIGHTS.get(str(model))) is None:
        if Path(model).suffix != ".onnx":
            raise InvalidArgument("model", f"one of {', '.join(_WEIGHTS)}, or an ONNX file", repr(str(model)))
        known = {weights.file: weights for weights in _WEIGHTS.values()}
        return Path(model), known.get(Path(model).name, _WEIGHTS[_DEFAULT])
    folder = Path(os.environ.get(_FOLDER_VARIABLE, _FOLDER)).expanduser()
    path, url = folder / weights.file, f"{_RELEASE}/{weights.file}"
    if not path.is_file():
        _download(url, path, weights.md5)
    return path, weights


def _download(url: str, path: Path, md5: str) -> None:
    """Fetch weights, whole or not at all, with a progress bar on a terminal."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            torch.hub.download_url_to_file(url, str(temporary), progress=os.isatty(2))
            if hashlib.md5(temporary.read_bytes(), usedforsecurity=False).hexdigest() != md5:
                raise OSError("the file has another checksum")
    except OSError as error:  # of the network, too
        reason = " ".join(str(error).split())
        hint = f"download {url} to {path}, or pass model=FOLDER/{path.name}"
        raise ValueError(f"cannot load the weights of {path.stem}: {reason}; {hint}") from error
