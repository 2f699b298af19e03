"""The end of the CPU kernel's backward: from the terms of pairs to the gradients of the Gaussians."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kcgs.compiled.program import inner

from ..moments import geometry_gradient
from ..whitened import SCALE
from .layout import COLOR_FACTOR, L11, L21, L22, LEVEL


class Backward(NamedTuple):
    """Arrays that `sum_terms` reads and fills, in the caller's order of Gaussians."""

    factors: Any  # [N, 3] float32, Cholesky factors
    means_gradient: Any  # [N, 2] float32
    cholesky_gradient: Any  # [N, 3] float32
    colors_gradient: Any  # [N, C] float32


_geometry_gradient = inner(geometry_gradient)


@inner
def sum_terms(lists, backward, terms, begin, end):
    """Sum the terms of some Gaussians in float64 and turn them into gradients; docs/performance.md has formulas.

    Args:
        lists: Lists.
        backward: Backward.
        terms: (P, ...) float32, as loops.sum_rows fills them.
        begin: the first Gaussian, in the lists' order.
        end: the last Gaussian + 1.
    """
    channels = backward.colors_gradient.shape[1]
    t, mean, factor = np.empty(terms.shape[1]), np.empty(2), np.empty(3)
    for i in range(begin, end):
        t[:] = 0.0
        for place in range(lists.first_terms[i], lists.first_terms[i] + lists.num_terms[i]):
            for k in range(len(t)):
                t[k] += terms[place, k]
        g, n = lists.gaussians[i], lists.order[i]
        by_factor = 0.0
        for c in range(channels):
            by_factor += t[c] * (lists.colors[i * channels + c] / g[COLOR_FACTOR])
            backward.colors_gradient[n, c] = t[c] * g[COLOR_FACTOR]
        s1, s2 = t[channels] / SCALE, t[channels + 1] / SCALE
        s11, s12 = t[channels + 2] / (SCALE * SCALE), t[channels + 3] / (SCALE * SCALE)
        s22 = t[channels + 4] / (SCALE * SCALE)
        mean[0], mean[1], factor[0], factor[1], factor[2] = _geometry_gradient(
            s1, s2, s11, s12, s22, g[L11], g[L21], g[L22]
        )
        if g[LEVEL] > 0:
            _uncoarsen(g, backward.factors[n], mean, factor, by_factor)
        backward.means_gradient[n, 0], backward.means_gradient[n, 1] = mean[0], mean[1]
        for k in range(3):
            backward.cholesky_gradient[n, k] = factor[k]


@inner
def _uncoarsen(g, fine, mean, factor, by_factor):
    """Convert the gradients of a mean and a factor from nodes to pixels: the backward of coarse_grids.coarsen.

    `fine` is the factor in pixels, `by_factor` the gradient of COLOR_FACTOR.
    """
    h = float(1 << int(g[LEVEL]))
    l11, l21, l22, c11, c22 = fine[0], fine[1], fine[2], g[L11] * h, g[L22] * h
    g11, g21, g22 = factor[0] / h, factor[1] / h, factor[2] / h
    scaled = by_factor * g[COLOR_FACTOR]
    shift = h * h / 3 * l21 / (c11 * c11)
    last = (g22 - scaled / c22) / c22
    first = (g11 - scaled / c11) * l11 - g21 * shift + last * shift * l21 * l11 / c11
    mean[0], mean[1] = mean[0] / h, mean[1] / h
    factor[0] = scaled / l11 + first / c11
    factor[1] = g21 * l11 / c11 - last * shift
    factor[2] = scaled / l22 + last * l22
