"""What a test that needs real time takes for a machine without room."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def conftest(request: pytest.FixtureRequest) -> ModuleType:
    path = Path(__file__).with_name("conftest.py")
    module = request.config.pluginmanager.get_plugin(str(path))
    assert isinstance(module, ModuleType)
    return module


@pytest.mark.parametrize(
    ("idle", "own", "others", "share"),
    [
        ([0.0] * 12, [2.0] * 12, [0.0] * 12, 0.0),  # busy by ourselves: no excuse
        ([1.0] * 12, [0.5] * 12, [0.5] * 12, 0.0),  # there was room
        ([0.0] * 12, [1.5] * 12, [0.5] * 12, 0.25),
        ([0.5] * 4 + [0.0] * 6 + [0.5] * 2, [1.5] * 4 + [1.0] * 6 + [1.5] * 2,
         [0.0] * 4 + [1.0] * 6 + [0.0] * 2, 0.5),  # for a while
        ([0.0] * 3, [0.0] * 3, [2.0] * 3, 0.0),  # too short to tell
    ],
)  # fmt: skip
def test_other_work_counts_while_nothing_is_idle(conftest, idle, own, others, share):
    busy = [a + b for a, b in zip(own, others, strict=True)]
    columns = [accumulate(column, initial=7.0) for column in (idle, busy, own)]
    readings = [
        conftest.Reading(float(k), *row) for k, row in enumerate(zip(*columns, strict=True))
    ]
    assert conftest.most_other_work(readings) == pytest.approx(share)


def test_a_reading_knows_its_own_work(conftest):
    before = conftest.read_processors()
    while (after := conftest.read_processors()).own_s < before.own_s + 0.2:
        pass
    assert after.wall_s > before.wall_s
    assert after.busy_s > before.busy_s
