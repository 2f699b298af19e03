"""The end of the CPU kernel's backward: from the terms of the lists' entries to the gradients of the Gaussians."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled import inner
from .layout import COLOR_FACTOR, GAUSSIAN, L11, L21, L22, LEVEL, SCALE, program


class GaussianGradients(NamedTuple):
    """What `sum_terms` fills, in the caller's order."""

    means: Any  # [N, 2] float32
    cholesky: Any  # [N, 3] float32
    colors: Any  # [N, C] float32


@program.entry
def sum_terms(lists, order, factors, terms, geometry, gradients):  # type: ignore[no-untyped-def]
    """Add up each Gaussian's terms in float64 and turn them into gradients; the formulas are in docs/performance.md.

    Args:
        lists: Lists.
        order: (N,) int64, from the table's order to the caller's.
        factors: (N, 3) float32, Cholesky factors in the caller's order.
        terms: (E, ...) float32, as loops.gather_gradients fills them.
        geometry: whether they hold moments of z, too.
        gradients: GaussianGradients; without `geometry` its colours alone are filled.
    """
    count, channels = gradients.colors.shape
    total = np.zeros((count, terms.shape[1]))
    mean, factor = np.empty(2), np.empty(3)
    for e in range(terms.shape[0]):
        for k in range(terms.shape[1]):
            total[lists.entries[e, GAUSSIAN], k] += terms[e, k]
    for i in range(count):
        t, g, n = total[i], lists.gaussians[i], order[i]
        by_factor = 0.0
        for c in range(channels):
            by_factor += t[c] * (lists.colors[i * channels + c] / g[COLOR_FACTOR])
            gradients.colors[n, c] = t[c] * g[COLOR_FACTOR]
        if geometry:
            s1, s2 = t[channels] / SCALE, t[channels + 1] / SCALE
            s11, s12 = t[channels + 2] / (SCALE * SCALE), t[channels + 3] / (SCALE * SCALE)
            s22 = t[channels + 4] / (SCALE * SCALE)
            slope = g[L21] / g[L22]
            mean[0], mean[1] = (s1 - slope * s2) / g[L11], s2 / g[L22]
            factor[0], factor[1], factor[2] = (s11 - slope * s12) / g[L11], s12 / g[L22], s22 / g[L22]
            if g[LEVEL] > 0:
                _uncoarsen(g, factors[n], mean, factor, by_factor)
            gradients.means[n, 0], gradients.means[n, 1] = mean[0], mean[1]
            for k in range(3):
                gradients.cholesky[n, k] = factor[k]


@inner
def _uncoarsen(g, fine, mean, factor, by_factor):  # type: ignore[no-untyped-def]
    """Turn the gradients of a mean and a factor on their level into those in pixels, as coarse_grids.uncoarsen does.

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
