"""What the library computes has not changed by a bit since it was recorded; see record.py."""

from __future__ import annotations

import json

import pytest

from . import record

EXPECTED = json.loads(record.EXPECTED.read_text())


def test_every_case_is_recorded() -> None:
    assert list(EXPECTED["digests"]) == list(record.CASES)


@pytest.mark.parametrize("group", dict.fromkeys(name.partition("/")[0] for name in record.CASES))
def test_nothing_changed(group: str) -> None:
    platform = record.describe_platform()
    if others := {key: (value, platform[key]) for key, value in EXPECTED["platform"].items() if platform[key] != value}:
        pytest.skip(f"bits were recorded on another platform (recorded, running): {others}")
    names = [name for name in record.CASES if name.startswith(f"{group}/")]
    changes = {name: record.differences(name, EXPECTED["digests"][name]) for name in names}
    assert not {name: values for name, values in changes.items() if values}
