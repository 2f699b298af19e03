"""Video codecs to compare with: clips of a wanted size by x264, x265 and AV1."""

from __future__ import annotations

import math
import os
import re
from fractions import Fraction
from typing import Any, Literal, NamedTuple

from torch import Tensor
from torch.nn.functional import pad

from kcgs._repr import brief
from kcgs.data._yuv import frame_from_rgb, rgb_from_frame, tag_bt709

VideoCodec = Literal["x264", "x265", "av1"]


class _Encoder(NamedTuple):
    library: str
    decoder: str
    options: dict[str, str]
    own: tuple[str, str]  # the option that takes the library's own settings, and these
    crf: tuple[float, float, float]  # lowest, highest, step


_GOP = 9999
_SLOPE = 0.12  # of the logarithm of the size per crf, about
_CLOSE = 2e-3  # a stream that leaves so little of its bytes is the largest one
_ENCODERS = {
    "x264": _Encoder(
        "libx264", "h264", {"preset": "veryslow", "tune": "psnr"}, ("x264-params", "threads=1"), (0, 51, 0.02)
    ),
    "x265": _Encoder(
        "libx265",
        "hevc",
        {"preset": "slower", "tune": "psnr"},
        ("x265-params", "pools=none:frame-threads=1:log-level=none:info=0"),
        (0, 51, 0.1),
    ),
    "av1": _Encoder(
        "libsvtav1", "libdav1d", {"preset": "3"}, ("svtav1-params", "tune=1:hierarchical-levels=3:lp=1"), (1, 63, 0.25)
    ),
}


@brief
class EncodedClip(NamedTuple):
    """A clip at a size: its bytes, the frames that a decoder makes of them, and the settings that gave them.

    The bytes are the elementary stream with its parameter sets, which decodes by itself: Annex B or OBUs, without a
    container and without the text that x264 and x265 leave about themselves.
    """

    data: bytes
    decoded: list[Tensor]
    settings: dict[str, Any]


def is_there(codec: VideoCodec) -> bool:
    """Say whether PyAV is installed, with this encoder in it."""
    try:
        from av import Codec

        Codec(_ENCODERS[codec].library, "w")
    except (ImportError, ValueError):
        return False
    return True


def encode_at(frames: list[Tensor], codec: VideoCodec, num_bytes: int, *, pixel_format: str = "yuv420p") -> EncodedClip:
    """Encode frames (3, H, W) in [0, 1] in constant quality: the largest stream that has at most `num_bytes`.

    One key frame, slow presets tuned for PSNR, one thread. Raises ValueError where even the lowest quality
    is larger, ImportError without PyAV.
    """
    encoder = _ENCODERS[codec]
    height, width = frames[0].shape[-2:]
    even = [pad(frame[None], (0, width % 2, 0, height % 2), mode="replicate")[0] for frame in frames]
    best, crf, smallest = _search(even, encoder, num_bytes, pixel_format)
    if best is None:
        raise ValueError(f"num_bytes must be at least {smallest} for these frames in {codec}; got {num_bytes}")
    decoded = [frame[..., :height, :width] for frame in decode(best, codec)]
    settings = {"encoder": encoder.library, "crf": crf, "pixel_format": pixel_format, **encoder.options}
    return EncodedClip(best, decoded, settings | {encoder.own[0]: encoder.own[1]})


def _search(
    frames: list[Tensor], encoder: _Encoder, num_bytes: int, pixel_format: str
) -> tuple[bytes | None, float, int]:
    """Bracket the crf: by a line through the logarithms of the sizes, and by halving."""
    lowest, highest, step = encoder.crf
    prepared = [frame_from_rgb(frame, pixel_format) for frame in frames]
    large, small = -1, round((highest - lowest) / step)  # crf in steps: one too large, one that fits
    sizes: dict[int, float] = {}
    best: tuple[bytes, int] | None = None
    guess = round((35 - lowest) / step)
    while True:
        data = _encode(prepared, encoder, lowest + guess * step)
        sizes[guess] = math.log(len(data) / num_bytes)
        if len(data) <= num_bytes:
            small, best = guess, (data, guess) if best is None or len(data) >= len(best[0]) else best
        else:
            large = guess
        if best is None and guess == round((highest - lowest) / step):
            return None, highest, len(data)
        if best and ((small - large <= 1 and small in sizes) or -_CLOSE < sizes[guess] <= 0):
            return best[0], round(lowest + best[1] * step, 3), 0
        guess = _next(sizes, large, small, step)


def _next(sizes: dict[int, float], large: int, small: int, step: float) -> int:
    """Choose the next crf between two bounds, where a line through them says zero."""
    low, high = sizes.get(large), sizes.get(small)
    if low is None or high is None:
        near = min(sizes, key=lambda known: abs(sizes[known]))
        aim = near + sizes[near] / (_SLOPE * step)
    elif len(sizes) % 3 == 2:  # sizes jump, and may even fall with the crf: a line alone would creep
        aim = (large + small) / 2
    else:
        aim = large + (small - large) * low / (low - high)
    return max(large + 1, min(small - (small in sizes), math.ceil(aim)))


def _encode(frames: list[Any], encoder: _Encoder, crf: float) -> bytes:
    from av import CodecContext

    os.environ.setdefault("SVT_LOG", "1")  # SVT-AV1 writes its settings to standard error otherwise
    context: Any = CodecContext.create(encoder.library, "w")
    context.width, context.height = frames[0].width, frames[0].height
    context.pix_fmt = frames[0].format.name
    context.framerate, context.gop_size = 24, _GOP
    context.time_base = Fraction(1, 24)
    context.thread_count = 1
    tag_bt709(context)
    name, own = encoder.own
    # FFmpeg's own option rounds the crf of SVT-AV1, which takes quarters.
    own += f":crf={crf:.2f}" if encoder.library == "libsvtav1" else ""
    context.options = encoder.options | {"crf": f"{crf:.2f}", name: own}
    packets = []
    for number, frame in enumerate(frames):
        frame.pts = number
        packets += context.encode(frame)
    packets += context.encode(None)
    data = b"".join(bytes(packet) for packet in packets)
    return _without_notes(data) if encoder.library == "libx264" else data


def _without_notes(data: bytes) -> bytes:
    """Take out units of type 6 of an H.264 stream, in which x264 writes its settings as text."""
    units = re.split(rb"(?=\x00\x00\x00\x01)|(?<!\x00)(?=\x00\x00\x01)", data)
    return b"".join(unit for unit in units if unit and unit.split(b"\x01", 1)[1][0] & 31 != 6)


def decode(data: bytes, codec: VideoCodec) -> list[Tensor]:
    """Decode an elementary stream that `encode_at` made to frames (3, H, W) float32 in [0, 1]."""
    from av import CodecContext

    context: Any = CodecContext.create(_ENCODERS[codec].decoder, "r")
    packets = [*context.parse(data), *context.parse(None)]
    frames = [frame for packet in [*packets, None] for frame in context.decode(packet)]
    return [rgb_from_frame(frame) for frame in frames]
