"""docs/reference/formats.md says what the code writes and reads."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from companion.flight.recorder import ESTIMATE_COLUMNS, EVENT_COLUMNS, TARGET_COLUMNS
from companion.targets.detections import Detection, parse_detection
from localizer.evaluation.metrics import LocalizationMetrics
from localizer.evaluation.sequences import CSV_COLUMNS
from localizer.tracking.engine_health import EngineHealth
from localizer.types import TrackingState
from mavlink_bridge.messages import HealthLevel

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "formats.md").read_text(
    encoding="utf-8"
)


def _section(begin, end):
    return TEXT[TEXT.index(begin) : TEXT.index(end, TEXT.index(begin) + 1)]


def _codes(text):
    return re.findall(r"`([^`\n]+)`", text)


@pytest.mark.parametrize(
    ("begin", "end", "columns"),
    [
        ("**estimates.csv**", "**targets.csv**", ESTIMATE_COLUMNS),
        ("**targets.csv**", "**events.csv**", TARGET_COLUMNS),
        ("**events.csv**", "**snapshots/", EVENT_COLUMNS),
        ("| values of `frames.csv` |", "## Trajectory", ("frames.csv", *CSV_COLUMNS)),
    ],
)
def test_columns_stand_in_their_order(begin, end, columns):
    found = [c for c in _codes(_section(begin, end)) if c in columns]
    assert tuple(found) == columns


def test_what_json_files_hold():
    report = _section("| values of `report.json` |", "| values of `frames.csv` |")
    assert {f.name for f in dataclasses.fields(LocalizationMetrics)} <= set(_codes(report))
    health = set(_codes(_section("**health.json**", "**.tlog**")))
    assert {f.name for f in dataclasses.fields(EngineHealth)} <= health
    assert {level.value for level in HealthLevel} <= health
    assert {state.value for state in TrackingState} <= set(_codes(TEXT))


def test_the_example_of_a_detection_is_one():
    example = re.search(r"```json\n(.*?)\n```", TEXT, re.DOTALL)
    assert example is not None
    detection, _ = parse_detection(example.group(1).encode())
    assert detection == Detection(**json.loads(example.group(1)))
