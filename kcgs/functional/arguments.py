"""What the operator takes, and the plan that a forward leaves for its backward."""

from __future__ import annotations

import threading
import weakref
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
    labels: Tensor | None  # [k * H, k * W] or [B, ...] int64; of the map at its own size, if that is another
    widths: Tensor | None  # [P, 3] float64: a pair of ids and its contour width; None: all are hard
    supersample: int  # k
    height: int
    width: int
    cutoff: float
    backend: str

    def inputs(self, *others: Any) -> SplatInputs:
        """Return what a kernel takes: the Gaussians with B, and `others`."""
        gaussians: Any = self[:3] if self.means.ndim == 3 else (t.unsqueeze(0) for t in self[:3])
        return SplatInputs(*gaussians, *others)


class KeptPlan(NamedTuple):
    """A plan, and what it was made of: under a transform the backward may be of other tensors."""

    tensors: tuple[Any, ...]  # weak references
    others: tuple[Any, ...]  # inputs of the kernel but the Gaussians
    steps: Steps
    plan: Any

    @classmethod
    def of(cls, given: Arguments, inputs: SplatInputs, steps: Steps, plan: Any) -> KeptPlan:
        """Keep a plan of these arguments, and what else the kernel got, for as long as the graph lives."""
        return cls(tuple(None if t is None else weakref.ref(t) for t in given[:6]), inputs[3:], steps, plan)

    def is_of(self, given: Arguments) -> bool:
        """Whether these are the tensors that the plan was made of."""
        return all((None if r is None else r()) is t for r, t in zip(self.tensors, given, strict=False))


class _Plans(threading.local):
    """The plan on its way from a forward to its graph, which asks for it, or from there to a backward."""

    wanted = False
    kept: KeptPlan | None = None


plans = _Plans()
