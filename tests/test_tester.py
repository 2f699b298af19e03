"""The form that tests of operations have holds for those to come."""

from __future__ import annotations

import pytest
import torch

from tests.tester import CASES, BaseTester


def make(without: dict[str, str], *cases: str) -> type:
    return type("TestNew", (BaseTester,), dict.fromkeys(cases, lambda self: None), without=without)


def test_a_case_that_is_forgotten() -> None:
    case, *others = CASES
    with pytest.raises(TypeError, match=f"TestNew must have {case} .*, or say in `without` why"):
        make({case: ""}, *others)
    assert make({case: "there is none"}, *others)
    with pytest.raises(TypeError, match=f"TestNew has {case}, which `without`"):
        make({case: "there is none"}, *CASES)
    with pytest.raises(TypeError, match="without must name cases; got test_smell"):
        make({"test_smell": "there is none"}, *CASES)


def test_what_would_hide_an_error() -> None:
    with pytest.raises(AssertionError, match="all-zero answer"):
        BaseTester.assert_close(torch.zeros(3), torch.zeros(3))
    with pytest.raises(AssertionError, match="all-zero gradient"):
        BaseTester.gradcheck(lambda x: 0 * x, [torch.ones(2)])
    for dtype, error in ((torch.float64, 1e-9), (torch.float32, 1e-4), (torch.float16, 2e-2), (torch.bfloat16, 0.2)):
        one = torch.ones(3, dtype=dtype)
        BaseTester.assert_close(one * (1 + error / 50), one)
        with pytest.raises(AssertionError):
            BaseTester.assert_close(one * (1 + error), one)
