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
    "guardian": {"enabled": False},
    "camera.settings.stamps_late_ms": 40.0,
    "localizer.odometry.terrain": "ground.tif",
}
CONSTANTS = (
    "localizer.registration", "localizer.integrity.chi2_threshold", "localizer.odometry.anchors",
    "prior.recall_s", "integrity_monitor.protection.map_m", "bridge.injection.yaw_guard.enabled",
    "targets.map_sigma_m", "camera.settings.retry_max_s",
)  # fmt: skip


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


INSIDE = ("prior", "record", "bridge.signing", "bridge.ground_signing")
ALONE = [key for key in REMOVED if not key.startswith(INSIDE)]


@pytest.mark.parametrize("old", [*ALONE, *CONSTANTS])
def test_a_removed_setting_is_left_out_with_a_warning(old, caplog):
    with caplog.at_level(logging.WARNING):
        assert config(nested(old, 0.5)) == config({})
    assert "has no effect since 0.2" in caplog.text
    assert caplog.text.count("remove it") == 1


def test_a_removed_setting_beside_others(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        found = config({"record": {"folder": "flight", "mcap": True}})
    assert found == config({"record": {"folder": "flight"}})
    assert "record.mcap has no effect since 0.2" in caplog.text


def test_an_old_section_with_an_old_key(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert config({"guardian": {"untold_jump_m": 2.0}}) == config({})
    assert caplog.text.count("since 0.2") == 2


def test_a_key_under_both_names_is_refused() -> None:
    with pytest.raises(ConfigError, match="guardian: no such setting"):
        config({"guardian": {}, "integrity_monitor": {}})


def config(changes: dict[str, Any]) -> CompanionConfig:
    camera = CAMERA | changes.get("camera", {})
    return parse_config(MINIMAL | changes | {"camera": camera}, "deployment.yaml")
