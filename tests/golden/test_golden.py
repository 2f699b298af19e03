"""What the library computes has not changed by a bit since it was recorded; see record.py."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

HERE = Path(__file__).parent


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # cases import their neighbours by these names
    spec.loader.exec_module(module)
    return module


record = load("record")
KEPT = json.loads(record.EXPECTED.read_text())


def test_every_case_is_recorded() -> None:
    assert list(KEPT["digests"]) == list(record.CASES)


@pytest.mark.parametrize("group", dict.fromkeys(name.partition("/")[0] for name in record.CASES))
def test_nothing_changed(group: str) -> None:
    running = record.describe_platform()
    other = {key: (value, running.get(key)) for key, value in KEPT["platform"].items() if running.get(key) != value}
    if other:
        pytest.skip(f"bits were recorded on another platform (recorded, running): {other}")
    names = [name for name in record.CASES if name.startswith(f"{group}/")]
    different = {name: record.differences(name, KEPT["digests"][name]) for name in names}
    assert not {name: values for name, values in different.items() if values}
