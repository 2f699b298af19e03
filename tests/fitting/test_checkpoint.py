"""A fit that was killed goes on where it stood."""

from __future__ import annotations

import hashlib
import io
import random
from pathlib import Path

import pytest
import torch

from kcgs import FitConfig, fit
from kcgs.fitting import FitResult, make_problem
from kcgs.fitting.checkpoint import Checkpoint
from kcgs.fitting.start import start

from .textures import quick, same, scene


class _Killed(BaseException):
    pass


@pytest.fixture(scope="module")
def uninterrupted() -> dict[str, FitResult]:
    image, labels = scene()
    return {recipe: fit(image, labels, 30, recipe=quick(recipe)) for recipe in ("best", "paper")}


class TestCheckpoint:
    @pytest.mark.usefixtures("clock")  # it says when the file is written
    @pytest.mark.parametrize(("recipe", "killed_at"), [("best", 1), ("best", 75), ("best", 119), ("paper", 47)])
    def test_resumed_is_uninterrupted(
        self, tmp_path: Path, uninterrupted: dict[str, FitResult], recipe: str, killed_at: int
    ) -> None:
        image, labels = scene()
        config, file, whole = quick(recipe), tmp_path / "state", uninterrupted[recipe]

        def kill(iteration: int, _: object) -> None:
            if iteration == killed_at:
                raise _Killed

        with pytest.raises(_Killed):
            fit(image, labels, 30, recipe=config, checkpoint=file, on_step=kill)
        resumed = fit(image, labels, 30, recipe=config, checkpoint=file, resume=True)
        assert same(whole, resumed)
        timeless = [[h._replace(seconds=0.0) for h in result.history] for result in (whole, resumed)]
        assert timeless[0] == timeless[1]

    def test_finished_gives_the_same_again(self, tmp_path: Path) -> None:
        image, labels = scene()
        first, again = (
            fit(image, labels, 30, recipe=quick(iterations=3), checkpoint=tmp_path / "state", resume=True)
            for _ in range(2)
        )
        assert same(first, again)

    def test_another_problem_is_refused(self, tmp_path: Path) -> None:
        image, labels = scene()
        file = tmp_path / "state"
        fit(image, labels, 30, recipe=quick(iterations=3), checkpoint=file)
        before = file.read_bytes()
        for change in ({"seed": 1}, {"image": 1 - image}, {"num_gaussians": 31}, {"recipe": quick(iterations=4)}):
            arguments = {"image": image, "num_gaussians": 30, "recipe": quick(iterations=3), **change}
            with pytest.raises(ValueError, match="belongs to another fit"):
                fit(regions=labels, checkpoint=file, resume=True, **arguments)  # type: ignore[arg-type]
        assert file.read_bytes() == before

    def test_keeps_what_contours_took_of_the_clock(self, tmp_path: Path) -> None:
        image, labels = scene()
        problem = make_problem(image, labels, 30, FitConfig(max_seconds=9.0), 0)
        state, store = start(problem), Checkpoint(tmp_path / "state", problem)
        state.contour_seconds = [0.5, 0.25]
        store.write(state, 2.0)
        resumed, seconds = store.read()
        assert resumed.contour_seconds == [0.5, 0.25] and seconds == 2.0

    def test_another_version_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "fit.ckpt"
        content = io.BytesIO()
        torch.save({"problem": "", "seconds": 1.0}, content)
        path.write_bytes(hashlib.sha256(content.getvalue()).digest() + content.getvalue())
        with pytest.raises(ValueError, match="is of another version of kcgs: remove it, and fit anew"):
            fit(torch.rand(3, 8, 9), num_gaussians=4, checkpoint=path, resume=True)

    def test_damaged_is_refused(self, tmp_path: Path) -> None:
        image, labels = scene()
        file, rng = tmp_path / "state", random.Random(0)
        fit(image, labels, 30, recipe=quick(iterations=3), checkpoint=file)
        content, cases = file.read_bytes(), [b"", b"nothing of the kind"]
        for count in (0, 1, 2, 3) * 2:  # flipped bits; 0: a cut
            damaged = bytearray(content if count else content[: rng.randrange(len(content))])
            for bit in rng.sample(range(8 * len(content)), count):
                damaged[bit // 8] ^= 1 << bit % 8
            cases.append(bytes(damaged))
        for case in cases:
            file.write_bytes(case)
            with pytest.raises(ValueError, match=r"^checkpoint '.*' is damaged, or no checkpoint of a fit$"):
                fit(image, labels, 30, recipe=quick(iterations=3), checkpoint=file, resume=True)

    @pytest.mark.parametrize(
        ("file", "error", "words"),
        [
            ("none/state", FileNotFoundError, "checkpoint needs an existing folder"),
            (None, ValueError, "checkpoint must be a file to go on from, with resume; got None"),
        ],
    )
    def test_needs_a_file(self, tmp_path: Path, file: str | None, error: type[Exception], words: str) -> None:
        image, labels = scene()
        with pytest.raises(error, match=words):
            fit(image, labels, 5, recipe=quick(), checkpoint=file and tmp_path / file, resume=True)
