"""Whitened coordinates, of tensors and of the values of a graph."""

from __future__ import annotations

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from kcgs.kernels import affine_coefficients, least_whitened, whiten
from kcgs.onnx.graph import FLOAT, Graph

HALF = 8.0


def columns(count: int) -> tuple[Tensor, ...]:
    """Offsets from the mean within 30 pixels, and factors l11, l21, l22 of slanted Gaussians."""
    generator = torch.Generator().manual_seed(0)
    x, y, l11, l21, l22 = torch.rand(5, count, generator=generator, dtype=torch.float64)
    return 60 * x - 30, 60 * y - 30, 0.3 + 9 * l11, 20 * l21 - 10, 0.3 + 9 * l22


def test_forward_substitution() -> None:
    x, y, l11, l21, l22 = columns(50)
    factor = torch.stack([torch.stack([l11, 0 * l11], -1), torch.stack([l21, l22], -1)], -2)
    expected = torch.linalg.solve(factor, torch.stack([x, y], -1)).unbind(-1)
    torch.testing.assert_close(whiten(x, y, 1 / l11, l21 / l11, 1 / l22), expected)
    k0, k1, k2, k3, k4 = affine_coefficients(x - 3, y + 2, l11, l21, l22)
    torch.testing.assert_close((k0 + k1 * 3, k2 + k3 * 3 - k4 * 2), expected)


def test_least_over_a_square() -> None:
    x, y, l11, l21, l22 = columns(200)
    side = torch.linspace(-HALF, HALF, 65, dtype=torch.float64)
    points = x[:, None, None] + side, y[:, None, None] + side[:, None]
    factors = 1 / l11, l21 / l11, 1 / l22
    least = least_whitened(x, y, *factors, HALF)
    for bound, z in zip(least, whiten(*points, *(t[:, None, None] for t in factors)), strict=True):
        z = z.expand(-1, 65, 65)
        has_both = (z.amin((1, 2)) < 0) & (z.amax((1, 2)) > 0)
        assert 20 < has_both.sum() < 180
        torch.testing.assert_close(bound[~has_both], z.abs().amin((1, 2))[~has_both])
        assert (bound[has_both] < 0).all()


def test_values_of_a_graph_are_those_of_tensors() -> None:
    inputs = [t.float() for t in columns(50)]
    graph = Graph()
    values = [graph.input(name, FLOAT, ["N"]) for name in ("x", "y", "l11", "l21", "l22")]
    model = graph.close(graph.Concat(*affine_coefficients(*values), axis=0), "k", ["M"])
    feeds = {value.name: t.numpy() for value, t in zip(model.graph.input, inputs, strict=True)}
    (result,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, feeds)
    np.testing.assert_allclose(result, torch.cat(affine_coefficients(*inputs)), rtol=1e-6)
