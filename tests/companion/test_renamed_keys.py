"""Settings under the names that they had in 0.1: read, with a warning."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from companion.config import CompanionConfig, parse_config
from companion.errors import ConfigError
from companion.renamed_keys import REMOVED, RENAMED
from tests.companion.test_config import CAMERA, MINIMAL

VALUES: dict[str, Any] = {
    "guardian": {"jump_m": 7.0},
    "integrity_monitor.untold_jump_m": 2.5,
    "camera.settings.stamps_late_ms": 40.0,
    "localizer.integrity.distinct_from_m": 6.5,
    "localizer.integrity.gate": 41.0,
    "localizer.odometry.gate": 30.0,
    "localizer.relocalization.min_agreement": 0.61,
}


def nested(path: str, value: Any) -> dict[str, Any]:
    for name in reversed(path.split(".")):
        value = {name: value}
    found: dict[str, Any] = value
    return found


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_is_read_with_a_warning(old: str, caplog: pytest.LogCaptureFixture) -> None:
    today = nested(RENAMED[old], VALUES[old])
    with caplog.at_level(logging.WARNING):
        assert config(nested(old, VALUES[old])) == config(today)
    assert f"{old} is called {RENAMED[old]}" in caplog.text
    caplog.clear()
    config(today)
    assert not caplog.text


@pytest.mark.parametrize("old", REMOVED)
def test_a_removed_setting_is_left_out_with_a_warning(
    old: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        assert config(nested(old, 0.5)) == config({})
    assert f"{old} has no effect since 0.2" in caplog.text


def test_an_old_section_with_an_old_key() -> None:
    read = config({"guardian": {"untold_jump_m": 2.0}})
    assert read.integrity_monitor.unreported_jump_m == 2.0


def test_a_key_under_both_names_is_refused() -> None:
    with pytest.raises(ConfigError, match="guardian: no such setting"):
        config({"guardian": {}, "integrity_monitor": {}})


def config(changes: dict[str, Any]) -> CompanionConfig:
    camera = CAMERA | changes.get("camera", {})
    return parse_config(MINIMAL | changes | {"camera": camera}, "deployment.yaml")
