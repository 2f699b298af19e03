"""Elementary functions against the library's, and their own bits."""

from __future__ import annotations

import hashlib

import numpy as np

from kcgs.codec.exact import exp2, turn


class TestAgainstTheLibrary:
    def test_exp2(self) -> None:
        x = np.linspace(-60, 60, 40001)
        assert np.abs(exp2(x) / np.exp2(x) - 1).max() < 1e-15

    def test_exp2_of_whole_numbers_is_exact(self) -> None:
        x = np.arange(-1000, 1001, dtype=np.float64)
        assert (exp2(x) == np.ldexp(1.0, x.astype(np.int32))).all()

    def test_turn(self) -> None:
        share = np.linspace(0, 1, 20001)
        cos, sin = turn(share)
        assert max(np.abs(cos - np.cos(np.pi * share)).max(), np.abs(sin - np.sin(np.pi * share)).max()) < 1e-15


def test_bits_are_the_same_everywhere() -> None:
    x = np.linspace(-40, 40, 9973)
    found = np.concatenate([exp2(x), *turn((x + 40) / 80)])
    digest = hashlib.sha256(found.astype("<f8").tobytes()).hexdigest()
    assert digest == "b49209ad81f58afac91381f953cee7cf27fe602f2af2f2f935b2bab284e1643f"
