"""Clips encoded to a size by x264, x265 and AV1."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs.functional import psnr

av = pytest.importorskip("av", reason="video codecs need PyAV: pip install 'kcgs[video]'")
LIBRARIES = {"x264": "libx264", "x265": "libx265", "av1": "libsvtav1"}


def moving_clip(height: int = 64, width: int = 80) -> list[Tensor]:
    """Smooth noise that moves sideways."""
    noise = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0))
    wide = torch.nn.functional.interpolate(noise, size=(height, width + 16), mode="bicubic")[0].clamp(0, 1)
    return [wide[:, :, 4 * k : 4 * k + width] for k in range(4)]


@pytest.mark.parametrize("codec", LIBRARIES)
class TestEncodeAt:
    @pytest.fixture(autouse=True)
    def encoder(self, codec: str) -> None:
        try:
            av.codec.Codec(LIBRARIES[codec], "w")
        except ValueError:
            pytest.skip(f"the PyAV here has no encoder {LIBRARIES[codec]}")

    def test_size_and_frames(self, codec: str) -> None:
        from kcgs.bench._video_codecs import decode, encode_at

        frames = moving_clip()
        found = []
        for num_bytes in (1500, 4000):
            clip = encode_at(frames, codec, num_bytes)  # type: ignore[arg-type]
            assert 0.75 * num_bytes < len(clip.data) <= num_bytes
            assert [image.shape for image in clip.decoded] == [(3, 64, 80)] * 4
            assert all(torch.equal(a, b) for a, b in zip(clip.decoded, decode(clip.data, codec), strict=True))  # type: ignore[arg-type]
            found.append(float(torch.stack([psnr(a, b) for a, b in zip(clip.decoded, frames, strict=True)]).mean()))
            assert clip.settings["encoder"] == LIBRARIES[codec]
        assert 20 < found[0] < found[1]
        assert b"x264 - core" not in clip.data

    def test_odd_sizes(self, codec: str) -> None:
        from kcgs.bench._video_codecs import encode_at

        clip = encode_at(moving_clip(65, 79), codec, 4000)  # type: ignore[arg-type]
        assert [image.shape for image in clip.decoded] == [(3, 65, 79)] * 4

    def test_too_few_bytes(self, codec: str) -> None:
        from kcgs.bench._video_codecs import encode_at

        with pytest.raises(ValueError, match=f"num_bytes must be at least .* for these frames in {codec}; got 10"):
            encode_at(moving_clip(), codec, 10)  # type: ignore[arg-type]
