"""What the operator takes, and the plan that a forward leaves for its backward."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

from torch import Tensor

from kcgs.kernels import SplatInputs, Steps


class Arguments(NamedTuple):
    """Arguments of the operator; floating tensors share one dtype, float32 or float64.

    For one image B may be left out of means, cholesky, colors and region_ids together, and so of what comes back.
    """

    means: Tensor  # [B, N, 2]
    cholesky: Tensor  # [B, N, 3]
    colors: Tensor  # [B, N, C]
    region_ids: Tensor | None  # [B, N] int64
    labels: Tensor | None  # [H, W] or [B, H, W] int64; of the map at its own size, if that is another
    widths: Tensor | None  # float64, as of `widths_of`; None: all contours are hard
    height: int
    width: int
    cutoff: float
    backend: str


class KeptPlan(NamedTuple):
    """A plan, and what it was made of."""

    given: Arguments
    inputs: SplatInputs
    steps: Steps
    plan: Any

    def is_of(self, given: Arguments) -> bool:
        """Whether these are the same Gaussians: under a transform a backward may be of others."""
        return all([a is b for a, b in zip(self.given[:3], given[:3], strict=True)])


class _Plans(threading.local):
    """The plan on its way from a forward to its graph, which asks for it, or from there to a backward."""

    wanted = False
    kept: KeptPlan | None = None


plans = _Plans()
