"""Graphs: dtypes of what their bodies return, and of numbers."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest

from kcgs.onnx.graph import INT64, Graph, Value


def run(g: Graph, output: Value, **feeds: int) -> list[int]:
    session = onnxruntime.InferenceSession(g.close(output, "result", ["n"]).SerializeToString())
    (result,) = session.run(None, {name: np.array([number]) for name, number in feeds.items()})
    assert result.dtype == np.int64
    return list(result)


class TestGraph:
    @pytest.mark.parametrize(("count", "expected"), [(3, [6]), (4, [5])])
    def test_choose_integers(self, count: int, expected: list[int]) -> None:
        g = Graph()
        n = g.input("n", INT64, [1])
        assert run(g, g.choose(g.Less(n, 4), lambda: n * 2, lambda: n + 1), n=count) == expected

    def test_loop_over_integers(self) -> None:
        g = Graph()
        n = g.input("n", INT64, [1])
        assert run(g, g.loop(g.Squeeze(n), lambda turn: turn * turn), n=4) == [0, 1, 4, 9]

    def test_integers_refuse_a_float(self) -> None:
        g = Graph()
        with pytest.raises(AssertionError, match="a float is rounded"):
            g.input("n", INT64, [1]) * 0.5
