"""The form of the tests of an operation: what each has to show, and how results are compared.

A class derives from :class:`BaseTester` and has every case of ``CASES``, or says why it has not:
``class TestBand(BaseTester, without={"test_gradcheck": "labels are integers"})``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

CASES = {
    "test_smoke": "it runs, and the result is finite and not black",
    "test_cardinality": "shapes of results, for every shape of arguments",
    "test_exception": "arguments that are refused, and the error's message",
    "test_feature": "values that are computed in another way",
    "test_gradcheck": "gradients against finite differences",
    "test_module": "its twin, or its state, as a torch module",
    "test_dynamo": "compiled, it gives the same",
}
# relative and absolute, about eight roundings of a value of 1
TOLERANCES = {
    torch.bfloat16: (3e-2, 3e-2),
    torch.float16: (4e-3, 4e-3),
    torch.float32: (1e-5, 2e-6),
    torch.float64: (1e-10, 1e-11),
}
# warnings that the compiler causes inside torch
COMPILER_WARNINGS = (
    ("The .grad attribute of a Tensor that is not a leaf", UserWarning),
    (".*torch.autograd.function.Function.* should not be instantiated", DeprecationWarning),
)


class BaseTester:
    """Cases that a class must have, and comparisons that follow the dtype.

    Tests take the fixtures `device`, `dtype` and `backend`, which the command line chooses.
    """

    def __init_subclass__(cls, *, without: Mapping[str, str] | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        reasons = without or {}
        if unknown := set(reasons) - set(CASES):
            raise TypeError(f"{cls.__name__}: without must name cases; got {', '.join(sorted(unknown))}")
        for case, shows in CASES.items():
            present, excused = callable(getattr(cls, case, None)), bool(reasons.get(case))
            if not present and not excused:
                raise TypeError(f"{cls.__name__} must have {case} ({shows}), or say in `without` why it has none")
            if present and excused:
                raise TypeError(f"{cls.__name__} has {case}, which `without` says it cannot have")

    @staticmethod
    def assert_close(
        actual: Any, expected: Any, *, rtol: float | None = None, atol: float | None = None, zero: bool = False
    ) -> None:
        """Compare tensors, or sequences of them, by the coarser dtype; zeros must be meant, as `zero` says."""
        if not isinstance(expected, Tensor):
            for one, other in zip(actual, expected, strict=True):
                BaseTester.assert_close(one, other, rtol=rtol, atol=atol, zero=zero)
            return
        assert zero or bool(expected.detach().any()), "an all-zero answer would pass"
        relative, absolute = (max(TOLERANCES[t.dtype][k] for t in (actual, expected)) for k in (0, 1))
        torch.testing.assert_close(
            actual.detach().to(expected.dtype), expected.detach(),
            rtol=relative if rtol is None else rtol, atol=absolute if atol is None else atol,
        )  # fmt: skip

    @staticmethod
    def gradcheck(function: Callable[..., Any], inputs: Sequence[Any], *, fast_mode: bool = True) -> None:
        """Compare gradients with finite differences, in float64; tensors of integers stay as they are."""
        arguments = [
            t.detach().double().requires_grad_() if isinstance(t, Tensor) and t.is_floating_point() else t
            for t in inputs
        ]
        assert torch.autograd.gradcheck(function, arguments, fast_mode=fast_mode)
        floating = [t for t in arguments if isinstance(t, Tensor) and t.requires_grad]
        gradients = torch.autograd.grad(function(*arguments).square().sum(), floating)
        assert all(bool(g.any()) for g in gradients), "an all-zero gradient would pass"

    @classmethod
    def assert_compiles(
        cls,
        function: Callable[..., Tensor],
        *inputs: Any,
        leaves: Sequence[Tensor] = (),
        backend: str = "eager",
        fullgraph: bool = True,
        **tolerances: Any,
    ) -> None:
        """Compare a function with its compiled self: the result, and the gradients of `leaves`."""
        torch._dynamo.reset()
        if isinstance(function, nn.Module) and not leaves:
            leaves = list(function.parameters())
        results = []
        with warnings.catch_warnings():
            for words, kind in COMPILER_WARNINGS:
                warnings.filterwarnings("ignore", words, kind)
            for call in (torch.compile(function, backend=backend, fullgraph=fullgraph), function):
                result = call(*inputs)
                gradients = torch.autograd.grad(result.square().sum(), list(leaves)) if leaves else ()
                results.append([result, *gradients])
        torch._dynamo.reset()
        cls.assert_close(*results, **tolerances)
