"""Threads of torch and of the kernels while their short operations take turns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest
import torch

from kcgs import GaussianField, Scene
from kcgs.editing import delete_region, move_region
from kcgs.kernels import threads_for_kernels
from kcgs.kernels.threads import num_threads
from kcgs.rate import compress
from kcgs.segment import segment

SIZE = (24, 32)
LABELS = (torch.arange(32) >= 20).long().expand(SIZE)


@pytest.fixture
def three_threads() -> Iterator[None]:
    """Have torch take three threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def scene() -> Scene:
    return Scene(GaussianField.random(30, SIZE, regions=LABELS, seed=0), LABELS)


@pytest.mark.usefixtures("three_threads")
class TestThreads:
    def test_kernels_have_all(self) -> None:
        with threads_for_kernels(24 * 32):
            with threads_for_kernels(24 * 32):
                assert (torch.get_num_threads(), num_threads()) == (1, 3)
            assert (torch.get_num_threads(), num_threads()) == (1, 3)
        assert torch.get_num_threads() == num_threads() == 3

    def test_torch_has_all_on_large_images(self) -> None:
        with threads_for_kernels(1 << 22):
            assert torch.get_num_threads() == num_threads() == 3

    @pytest.mark.parametrize(
        ("name", "work"),
        [
            ("kcgs.editing.fill.inpaint_from_matches", lambda: delete_region(scene(), 1)),
            ("kcgs.editing.fill.inpaint_from_matches", lambda: move_region(scene(), 1, (-4, 0))),
            ("kcgs.segment.cleanup.merge_small", lambda: segment(torch.rand(3, *SIZE), "felzenszwalb")),
            ("kcgs.segment.methods.auto.clean", lambda: segment(torch.rand(3, *SIZE))),
            ("kcgs.rate.compress.psnr", lambda: compress(scene(), torch.rand(3, *SIZE), target_psnr=5.0)),
        ],
    )
    def test_short_operations(self, monkeypatch: pytest.MonkeyPatch, name: str, work: Callable[[], Any]) -> None:
        threads: list[tuple[int, int]] = []
        module, _, inner = name.rpartition(".")
        function = getattr(import_module(module), inner)

        def record(*arguments: Any, **settings: Any) -> Any:
            threads.append((torch.get_num_threads(), num_threads()))
            return function(*arguments, **settings)

        monkeypatch.setattr(import_module(module), inner, record)
        work()
        assert set(threads) == {(1, 3)} and torch.get_num_threads() == 3
