"""What the methods that run a network share: loading, preprocessing, reading out its maps."""

import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies

import torch
import torch.nn.functional as F
from torch import Tensor

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_LONGEST = 240  # Of an error's line: libraries list every weight.


def load_pretrained(class_name: str, model: Any, device: torch.device) -> Any:
    """Return a model of transformers in evaluation mode, from a folder, a hub id, or loaded already."""
    import transformers

    if isinstance(model, torch.nn.Module):
        return model.eval().to(device)
    model = str(Path(model).expanduser()) if str(model).startswith("~") else str(model)
    if (Path(model).is_absolute() or model.startswith(".") or model.count("/") > 1) and not Path(model).is_dir():
        raise FileNotFoundError(f"no folder with a model at {model}")
    log: Any = transformers.utils.logging
    level, bar = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity_error()
    log.disable_progress_bar()
    try:
        source = getattr(transformers, class_name)
        loaded, info = source.from_pretrained(model, output_loading_info=True, local_files_only=is_offline(model))
    except Exception as error:  # Whatever a damaged file, a wrong config or a missing network raises.
        raise ValueError(f"cannot load {model!r} as {class_name}: {first_line(error)}") from error
    finally:
        log.set_verbosity(level)
        if bar:
            log.enable_progress_bar()
    # Pooling heads are no part of many published checkpoints, and nothing here reads them.
    missing = sorted(key for key in info["missing_keys"] if "pooler" not in key)
    if missing:
        raise ValueError(f"cannot load {model!r} as {class_name}: it lacks {len(missing)} weights, as {missing[0]}")
    return loaded.eval().to(device)


def is_offline(model: str) -> bool:
    """Say whether to look on this disk only: the hub's library asks a hub that is out of reach for half a minute."""
    from huggingface_hub.constants import ENDPOINT

    if getproxies() or Path(model).is_dir():
        return False
    address = urlsplit(ENDPOINT)
    try:
        socket.create_connection((address.hostname or "", address.port or 443), timeout=3).close()
    except OSError:
        return True
    return False


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, with what it announces, not too long; or the error's kind."""
    lines = [" ".join(line.split()) for line in str(error).splitlines() if line.split()]
    if not lines:
        return type(error).__name__
    text = " ".join(lines[:2]) if lines[0].endswith(":") else lines[0]
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def preprocess(
    image: Tensor, size: tuple[int, int], mean: Sequence[float], std: Sequence[float], max_value: float = 1.0
) -> Tensor:
    """Return (3, H, W) as (1, 3, h, w) of ``size``, times ``max_value``, less ``mean``, over ``std``."""
    image = F.interpolate(image[None], size, mode="bilinear", align_corners=False, antialias=True) * max_value
    return (image - image.new_tensor(mean)[:, None, None]) / image.new_tensor(std)[:, None, None]


def largest_map(maps: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Enlarge maps (1, C, h, w) to ``size``; return index, value and softmax of the largest at every pixel.

    One at a time is enlarged, so that many classes of a large image fit.
    """
    best = torch.full(size, -torch.inf, device=maps.device)
    total, index = best.clone(), torch.zeros(size, dtype=torch.int64, device=maps.device)
    for k in range(maps.shape[1]):
        one = F.interpolate(maps[:, k : k + 1].float(), size, mode="bilinear", align_corners=False)[0, 0]
        index[one > best] = k
        best = torch.maximum(best, one)
        total = torch.logaddexp(total, one)
    return index, best, (best - total).exp()
