"""What README and the pages of docs/ tell readers to type: Python that runs, commands that kcgs takes."""

from __future__ import annotations

import doctest
import importlib.util
import os
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from torch import Tensor
from typer.main import get_command

import kcgs
from kcgs.cli import app
from kcgs.segment import registry
from kcgs.video import read_video, write_video
from tests.segment.test_onnx import write_mixer

ROOT = Path(kcgs.__file__).resolve().parent.parent
if not (ROOT / "docs/conf.py").is_file():
    pytest.skip("not a source checkout", allow_module_level=True)
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# of README, what is neither a matter of seconds nor ends by itself
NOT_RUN = {"demo", "view", "fit-many"}


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def python_blocks(page: Path) -> list[str]:
    """Return the blocks of Python with fewer iterations: 15 where there are more."""
    return [
        re.sub(r"\biterations=(\d+)", lambda match: f"iterations={min(int(match[1]), 15)}", block)
        for block in blocks(page, "python")
    ]


def commands(page: Path) -> list[list[str]]:
    """Return the kcgs commands in a page's shell blocks, split into words; comments and lines that go on are joined."""
    lines = "".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line[:1] == ["kcgs"]]


def with_any(page_blocks: Any) -> list[Any]:
    return [pytest.param(page, id=page.stem) for page in PAGES if page_blocks(page)]


@pytest.fixture
def folder(tmp_path: Path, astronaut: Tensor, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the pages name, small."""
    pixels = (astronaut[:, 0:192, 128:320].permute(1, 2, 0) * 255).byte().numpy()
    photo = Image.fromarray(pixels).resize((48, 48))
    photo.save(tmp_path / "photo.jpg", quality=95)
    (tmp_path / "photos").mkdir()
    photo.save(tmp_path / "photos/one.png")
    mask = Image.new("L", photo.size)
    mask.paste(1, (12, 8, 36, 48))
    mask.save(tmp_path / "mask.png")
    for name, whole in (("frames", photo), ("masks", mask)):
        (tmp_path / name).mkdir()
        for number in range(3):
            whole.crop((number, 0, number + 40, 48)).save(tmp_path / name / f"{number}.png")
    monkeypatch.setattr(registry, "_methods", dict(registry._methods))  # a page adds one of its own
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning", "ignore:.*:FutureWarning", "ignore:.*:UserWarning:torch")
@pytest.mark.filterwarnings("ignore:ms_ssim is NaN:RuntimeWarning")  # the photo is small
@pytest.mark.parametrize("page", with_any(lambda page: blocks(page, "python")))
def test_python_runs(page: Path, folder: Path) -> None:
    """All blocks of a page in one namespace, top to bottom; those with prompts print what they show."""
    namespace: dict[str, Any] = {"__name__": page.stem}
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for number, block in enumerate(python_blocks(page)):
        name = f"{page.name}, block {number}"
        if block.startswith(">>>"):
            test = doctest.DocTestParser().get_doctest(block, namespace, name, str(page), 0)
            assert runner.run(test, clear_globs=False).failed == 0, name
            namespace |= test.globs
        else:
            exec(compile(block, name, "exec"), namespace)


@pytest.mark.parametrize("page", with_any(commands))
def test_commands_are_taken(page: Path) -> None:
    """Names, options and values are as the command line knows them; nothing is run."""
    group: Any = get_command(app)
    for name, *arguments in commands(page):
        if not arguments and name.startswith("-"):
            continue  # kcgs --version
        assert name in group.commands, name
        with group.commands[name].make_context(name, list(arguments)):
            pass


@pytest.mark.slow
def test_readme_commands_run(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a row, as a reader would type them; in place of the downloaded network a small one finds what is bright."""
    write_mixer(tmp_path / "isnet-general-use.onnx", [[4.0, 4.0, 4.0]])
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    group: Any = get_command(app)
    videos = importlib.util.find_spec("av") is not None
    if videos:
        write_video("clip.mp4", read_video("frames"), 25)
    for arguments in commands(ROOT / "README.md"):
        if arguments[0] not in NOT_RUN and (videos or not any(word.startswith("clip.") for word in arguments)):
            group.main(arguments, prog_name="kcgs", standalone_mode=False)
    assert os.listdir(folder)
