"""What the specification rests on: elementary functions, the end of a stream, the error of rounding."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kcgs.codec.exact import cos_sin, exp2
from kcgs.codec.gaussians.quantize import Parameters, Quantizer
from kcgs.codec.labels.contexts import MAX_LOGIT, SQUASH
from kcgs.codec.rangecoder import Reader, Writer
from kcgs.functional import region_splat


class TestElementaryFunctions:
    def test_accuracy(self) -> None:
        x, share = np.linspace(-60, 60, 40001), np.linspace(0, 1, 20001)
        assert np.abs(exp2(x) / np.exp2(x) - 1).max() < 1e-15
        cos, sin = cos_sin(share)
        assert max(np.abs(cos - np.cos(np.pi * share)).max(), np.abs(sin - np.sin(np.pi * share)).max()) < 1e-15

    def test_squash_does_not_depend_on_the_last_digit_of_exp(self) -> None:
        exact = 65536 / (1 + np.exp(-np.arange(-MAX_LOGIT, MAX_LOGIT + 1) / 256))
        assert np.array_equal(SQUASH, np.rint(exact))
        assert np.abs(np.abs(exact - np.floor(exact)) - 0.5).min() > 1e-6


class TestWriter:
    @settings(max_examples=60)
    @given(st.lists(st.tuples(st.integers(1, 65535), st.booleans()), max_size=200))
    def test_finish(self, symbols: list[tuple[int, bool]]) -> None:
        chances = np.array([chance / 65536 for chance, _ in symbols])
        values = np.array([value for _, value in symbols], np.int32)
        writer = Writer()
        writer.bits(chances, values)
        data = writer.finish()
        cost = -np.log2(np.where(values == 1, chances, 1 - chances)).sum()
        assert len(data) <= cost / 8 + 1.1
        assert np.array_equal(Reader(data).bits(chances, values), values)


class TestQuantizer:
    def test_distortion(self) -> None:
        """Each of the 8 numbers adds the distortion, where Gaussians are far apart and inside the image."""
        size, generator = (160, 160), np.random.default_rng(0)
        grid = np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2)
        l11, l21, l22 = generator.uniform(2, 5, 16), generator.uniform(-2, 2, 16), generator.uniform(2, 5, 16)
        cholesky, colors = np.stack([l11, l21, l22], -1), generator.uniform(0.3, 1.0, (16, 3))
        quantizer, total, rounds = Quantizer(200, size), 0.0, 8
        for _ in range(rounds):
            means = 40.0 * grid + 20 + generator.uniform(-2, 2, (16, 2))
            gaussians = Parameters(means, cholesky, colors)
            codes = quantizer.quantize(gaussians, quantizer.classify(gaussians))
            renders = [
                region_splat(*(torch.from_numpy(np.asarray(t, np.float64)) for t in numbers), size=size, cutoff=0.0)
                for numbers in (gaussians, quantizer.dequantize(codes))
            ]
            total += float((renders[0] - renders[1]).square().sum())
        expected = rounds * 16 * 8 * quantizer.distortion
        assert 0.75 * expected < total < 1.25 * expected
