"""Memory that a thread keeps from call to call."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from kcgs.compiled import workspace
from kcgs.compiled.workspace import Workspace


@pytest.fixture(autouse=True)
def empty_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workspace, "_thread", workspace.Thread())


def address_of(array: np.ndarray) -> int:
    return int(array.ctypes.data)


def test_next_call_has_the_memory() -> None:
    for _ in range(2):  # the first finds out how much a call needs
        Workspace().empty((1000, 3), np.float32)
    first = Workspace()
    address = address_of(first.empty(100, np.float32))
    del first
    second = Workspace()
    assert address_of(second.empty((1000, 3), np.float32)) == address
    other = Workspace()  # while the second is there
    assert address_of(other.empty(100, np.float32)) != address


def test_arrays_do_not_overlap() -> None:
    Workspace().empty(5000, np.uint8)
    space = Workspace()
    shapes = [((7, 3), np.float32), (5, np.int64), ((0, 4), np.int32), ((200, 5), np.float64)]
    arrays = [space.empty(shape, dtype) for shape, dtype in shapes]
    for value, (array, (shape, dtype)) in enumerate(zip(arrays, shapes, strict=True)):
        assert array.shape == np.empty(shape).shape and array.dtype == dtype and array.ctypes.data % 8 == 0
        array[...] = value
    assert all((array == value).all() for value, array in enumerate(arrays))


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


def test_each_thread_keeps_one() -> None:
    addresses: list[int] = []

    def work() -> None:
        for _ in range(3):
            space = Workspace()
            array = space.empty(1000, np.uint8)
        addresses.append(address_of(array))
        ready.wait(10)

    ready = threading.Barrier(2)
    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(addresses)) == 2
