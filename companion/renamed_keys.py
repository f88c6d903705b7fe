"""Settings that had another name in version 0.1: 0.2 reads them and warns, 0.3 will refuse them.

The one place that knows old names. It serves deployments, the deployment in a flight's record, and
scenario files.
"""

from __future__ import annotations

import logging
from typing import Any

_log = logging.getLogger(__name__)

RENAMED = {
    "guardian": "integrity_monitor",
    "integrity_monitor.untold_jump_m": "integrity_monitor.unreported_jump_m",
    "camera.settings.stamps_late_ms": "camera.settings.time_offset_ms",
    "localizer.integrity.distinct_from_m": "localizer.integrity.ambiguity_sigma_m",
    "localizer.integrity.gate": "localizer.integrity.chi2_threshold",
    "localizer.odometry.gate": "localizer.odometry.chi2_threshold",
}
"""Old path: new path, both in the same section; a section's own rename comes before its keys'."""

REMOVED = tuple(
    f"localizer.{section}.{key}"
    for section, keys in {
        "integrity": (
            "min_quality", "max_sigma_m", "min_agreement", "min_parts", "min_peak",
            "min_patch_inlier_ratio", "min_patches", "peak_to_sidelobe_min",
        ),
        "relocalization": (
            "min_quality", "max_sigma_m", "min_agreement", "min_patch_inlier_ratio",
            "max_focal_gain", "tilt_gate_deg", "height_gate_m", "decisive_agreement", "margin",
        ),
    }.items()
    for key in keys
)  # fmt: skip
"""Thresholds that `localizer.integrity.min_log_odds` replaces: left out, with a warning."""


def with_current_keys(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The settings under today's names; `where` names the file in the warnings.

    A key that is given under both names keeps both: the model then refuses the old one.
    """
    for old, new in RENAMED.items():
        *path, key = old.split(".")
        section: Any = data
        for name in path:
            section = section.get(name) if isinstance(section, dict) else None
        today = new.rpartition(".")[2]
        if isinstance(section, dict) and key in section and today not in section:
            _log.warning("%s: %s is called %s since 0.2: rename it", where, old, new)
            data = _renamed(data, path, key, today)
    for old in REMOVED:
        *path, key = old.split(".")
        section = data
        for name in path:
            section = section.get(name) if isinstance(section, dict) else None
        if isinstance(section, dict) and key in section:
            _log.warning("%s: %s has no effect since 0.2: remove it", where, old)
            data = _without(data, path, key)
    return data


def _without(data: dict[str, Any], path: list[str], key: str) -> dict[str, Any]:
    """A copy in which one key of a section is missing."""
    if not path:
        return {name: value for name, value in data.items() if name != key}
    return {**data, path[0]: _without(data[path[0]], path[1:], key)}


def _renamed(data: dict[str, Any], path: list[str], key: str, today: str) -> dict[str, Any]:
    """A copy in which one key of a section has its new name, in its old place."""
    if not path:
        return {today if name == key else name: value for name, value in data.items()}
    return {**data, path[0]: _renamed(data[path[0]], path[1:], key, today)}
