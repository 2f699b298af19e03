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
from kcgs.segment.networks import IMAGENET_MEAN, IMAGENET_STD
from kcgs.segment.prompts import Points, check_prompt, window_of
from kcgs.segment.registry import register

from .onnx import saliency

_RELEASE = "https://github.com/danielgatis/rembg/releases/download/v0.0.0"
# the folder of weights, shared with rembg
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
# width of the surroundings of a box that the network sees, in sides of the box: with less it mistakes parts for objects
_VIEW = 0.8
# smallest pieces and holes that stay, as a share of the network's view; larger ones are parts, such as spokes
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
    al., CAAI AIR 2024) and the small U-2-Net, in ONNX files of the project rembg: 179 MB, 973 MB and 4.6 MB. They are
    downloaded once, into ~/.u2net or the folder U2NET_HOME, as by rembg. With a box, the network sees the box and its
    surroundings, and the object is its mask inside the box. Clicks correct the mask as in the method "grabcut". The
    names of regions are "object" and "background".

    Args:
        image: as `segment` takes it, any size.
        model: isnet-general-use, birefnet-general or u2netp; or an ONNX file with the name of one of their files, or
            else a network with the normalisation of ISNet. The method "onnx" takes other networks.
        threshold: least score of the object's pixels, in [0, 1].
        pieces: True: every connected piece of the object is a region of its own; False: all pieces are one region.
        box: left, top, right, bottom in pixels, around the object; None: the whole image.
        foreground: :math:`(P, 2)` points (x, y) that the network missed, in pixels, in the box.
        background: :math:`(P, 2)` points (x, y) that the network took by mistake.

    Raises:
        ValueError: an unknown model, weights that cannot be downloaded, or a file that is no such network; a box
            without pixels of the image; points outside of the image or of the box; no object is found.
        ImportError: clicks need OpenCV, and it is not installed.

    Warns:
        UserWarning: the mask does not follow a click.

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
    scores[prediction.labels != labels] = torch.nan  # the network's score is of the other label
    prediction = prediction._replace(scores=scores)
    return _label_pieces(prediction) if pieces else prediction


def _label_pieces(prediction: Prediction) -> Prediction:
    """Make every connected piece of the object a label of its own."""
    from scipy import ndimage

    labels, count = ndimage.label(prediction.labels.numpy())
    return prediction._replace(labels=labels, names=NAMES[:1] + NAMES[1:] * count)


def _find_weights(model: str | os.PathLike[str]) -> tuple[Path, _Weights]:
    """Return the file of a network and its normalisation; download the file if it is missing."""
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
    """Download weights atomically, with a progress bar on a terminal."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            torch.hub.download_url_to_file(url, str(temporary), progress=os.isatty(2))
            if hashlib.md5(temporary.read_bytes(), usedforsecurity=False).hexdigest() != md5:
                raise OSError("the file has another checksum")
    except OSError as error:  # includes network errors
        reason = " ".join(str(error).split())
        hint = f"download {url} to {path}, or pass model=FOLDER/{path.name}"
        raise ValueError(f"cannot load the weights of {path.stem}: {reason}; {hint}") from error
