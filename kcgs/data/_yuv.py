"""RGB tensors and the frames of PyAV: matrix, range, bit depth and chroma sampling."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate, pad

# Weights of red and blue in luma, by the number of the matrix in H.273; 2 means that the file does not say.
_LUMA_WEIGHTS = {
    1: (0.2126, 0.0722),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}
_BT709, _BT601, _UNKNOWN = 1, 6, 2
_LIMITED, _FULL = 1, 2


def rgb_from_frame(frame: Any) -> Tensor:
    """Return (3, H, W) float32 in [0, 1] of a frame, by the matrix and the range that it names.

    Without a matrix, frames of 720 rows and more are BT.709 and smaller ones BT.601, as players take them. Without a
    range, YUV is limited and grey full. Alpha is ignored.
    """
    kind = frame.format
    if kind.is_rgb or kind.has_palette:
        deep = max(part.bits for part in kind.components) > 8
        values = frame.reformat(format="rgb48le" if deep else "rgb24").to_ndarray().astype(np.float32)
        return torch.from_numpy(values / np.float32(65535 if deep else 255)).permute(2, 0, 1).contiguous()
    if not _is_simple(kind, frame.width, frame.height):
        # The same samples in planes; 16 bits hold whatever was packed.
        grey = len([part for part in kind.components if not part.is_alpha]) == 1
        deep = "16le" if kind.components[0].bits > 8 else ""
        frame = frame.reformat(format="gray" + deep if grey else "yuv444p" + deep)
    bits = frame.format.components[0].bits
    # PyAV calls a component chroma only where it is subsampled.
    chroma = [part for part in frame.format.components if not part.is_alpha][1:]
    full = frame.color_range == _FULL or kind.name.startswith("yuvj") or (frame.color_range != _LIMITED and not chroma)
    scale, low, span = 2.0 ** (bits - 8), 0.0 if full else 16.0, 255.0 if full else 219.0
    top = 2.0**bits - 1 if full else span * scale
    luma: Tensor = (_plane(frame, 0, bits) - low * scale) / top
    if not chroma:
        return luma.clamp(0, 1).expand(3, -1, -1).contiguous()
    middle, reach = 2.0 ** (bits - 1), top if full else 224.0 * scale
    planes = torch.stack([_plane(frame, 1, bits), _plane(frame, 2, bits)])
    blue, red = upsample_chroma((planes - middle) / reach, luma.shape[-2], luma.shape[-1])
    return _to_rgb(luma, blue, red, _matrix(frame)).clamp(0, 1)


def frame_from_rgb(image: Tensor, pixel_format: str) -> Any:
    """Return a frame of `pixel_format` (planar YUV, little-endian), BT.709 of limited range, of (3, H, W)."""
    from av import VideoFrame

    red, green, blue = image.detach().float().cpu().clamp(0, 1)
    weight_red, weight_blue = _LUMA_WEIGHTS[_BT709]
    luma = weight_red * red + (1 - weight_red - weight_blue) * green + weight_blue * blue
    chroma = torch.stack([(blue - luma) / (2 - 2 * weight_blue), (red - luma) / (2 - 2 * weight_red)])
    frame = VideoFrame(image.shape[-1], image.shape[-2], pixel_format)
    second = frame.format.components[1]
    chroma = downsample_chroma(chroma, second.height < frame.height, second.width < frame.width)
    bits = frame.format.components[0].bits
    scale = 2 ** (bits - 8)
    values = [luma * (219 * scale) + 16 * scale, *(chroma * (224 * scale) + 128 * scale)]
    for index, samples in enumerate(values):
        levels = (samples + 0.5).floor().clamp(0, 2**bits - 1).numpy()
        _rows(frame, index, bits)[:] = levels
    frame.colorspace, frame.color_range = _BT709, _LIMITED
    frame.color_primaries, frame.color_trc = _BT709, _BT709
    return frame


def tag_bt709(context: Any) -> None:
    """Write into the stream of an encoder what `frame_from_rgb` makes: BT.709, limited range."""
    context.colorspace, context.color_range = _BT709, _LIMITED
    context.color_primaries, context.color_trc = _BT709, _BT709


def upsample_chroma(planes: Tensor, height: int, width: int) -> Tensor:
    """Bring (C, h, w) to (C, height, width) where it is half as large: cubic, samples at the left of pixel pairs."""
    if planes.shape[-2] < height:
        planes = interpolate(planes[None], size=(2 * planes.shape[-2], planes.shape[-1]), mode="bicubic")[0]
    if planes.shape[-1] < width:
        count = planes.shape[-1]
        wide = pad(planes, (1, 2, 0, 0), mode="replicate")
        inner = wide[..., 1 : count + 1] + wide[..., 2 : count + 2]
        between = (9 * inner - wide[..., :count] - wide[..., 3 : count + 3]) / 16
        planes = torch.stack([planes, between], -1).flatten(-2)
    return planes[..., :height, :width]


def downsample_chroma(planes: Tensor, rows: bool, columns: bool) -> Tensor:
    """Halve (C, H, W) in height and width where asked, the inverse of `upsample_chroma` with a half-band filter."""
    if columns:
        count = math.ceil(planes.shape[-1] / 2)
        wide = pad(planes, (3, 3 + planes.shape[-1] % 2, 0, 0), mode="replicate")
        taps = [(0, -1), (2, 9), (3, 16), (4, 9), (6, -1)]
        terms = [weight / 32 * wide[..., shift : shift + 2 * count - 1 : 2] for shift, weight in taps]
        planes = torch.stack(terms).sum(0)
    if rows:
        even = pad(planes, (0, 0, 0, planes.shape[-2] % 2), mode="replicate")
        size = (even.shape[-2] // 2, even.shape[-1])
        planes = interpolate(even[None], size=size, mode="bicubic", antialias=True)[0]
    return planes


def _to_rgb(luma: Tensor, blue: Tensor, red: Tensor, matrix: int) -> Tensor:
    weight_red, weight_blue = _LUMA_WEIGHTS[matrix]
    first = luma + (2 - 2 * weight_red) * red
    last = luma + (2 - 2 * weight_blue) * blue
    middle = (luma - weight_red * first - weight_blue * last) / (1 - weight_red - weight_blue)
    return torch.stack([first, middle, last])


def _matrix(frame: Any) -> int:
    named = int(frame.colorspace)
    if named == 10:  # constant luminance, which nobody records; its plain twin is near
        return 9
    if named in _LUMA_WEIGHTS:
        return named
    if named not in (0, _UNKNOWN, 3):
        raise ValueError(f"its colours are in matrix {named} of H.273, expected BT.601, BT.709 or BT.2020")
    return _BT709 if frame.height >= 720 else _BT601


def _is_simple(kind: Any, width: int, height: int) -> bool:
    """Whether the samples lie one after the other in planes, chroma as large as luma or half as large."""
    parts = [part for part in kind.components if not part.is_alpha]
    if kind.is_big_endian or kind.name.startswith("p0") or parts[0].bits < 8:
        return False
    if len(parts) == 1:
        return str(kind.name).startswith("gray")
    halves = parts[1].width in (width, math.ceil(width / 2)) and parts[1].height in (height, math.ceil(height / 2))
    return bool(kind.is_planar and halves and [part.plane for part in parts] == [0, 1, 2])


def _plane(frame: Any, index: int, bits: int) -> Tensor:
    return torch.from_numpy(_rows(frame, index, bits).astype(np.float32))


def _rows(frame: Any, index: int, bits: int) -> NDArray[Any]:
    """Return the samples of a plane, (h, w), in the memory of the frame."""
    plane: Any = frame.planes[index]
    samples = np.frombuffer(plane, np.uint8 if bits == 8 else np.dtype("<u2"))
    return samples.reshape(plane.height, -1)[:, : plane.width]
