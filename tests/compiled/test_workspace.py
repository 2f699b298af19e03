"""Memory that a thread keeps from call to call."""

from __future__ import annotations

import numpy as np
import pytest

from kcgs.compiled import workspace
from kcgs.compiled.workspace import Workspace


@pytest.fixture(autouse=True)
def empty_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workspace, "_kept", workspace._Kept())


def address_of(array: np.ndarray) -> int:
    return int(array.ctypes.data)


def test_rest_is_lent_to_one() -> None:
    for _ in range(2):
        Workspace().empty(4000, np.uint8)
    space = Workspace()
    kept = space.empty(100, np.uint8)
    with space.rest() as rest:
        address = address_of(rest.empty(100, np.uint8))
        with space.rest() as other:
            assert other is not space and address_of(other.empty(100, np.uint8)) != address
    with space.rest() as rest:
        assert address_of(rest.empty(100, np.uint8)) == address != address_of(kept)
