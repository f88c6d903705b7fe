"""A map that was altered after the deployment was made is refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.preflight.map_pin import map_hash, require_pinned


def test_an_altered_manifest_is_refused_and_the_right_one_is_not(tmp_path: Path) -> None:
    manifest = tmp_path / "manifest.json"
    manifest.write_text('{"geoid_separation_m": 47.5}')
    pin = map_hash(tmp_path)
    require_pinned(tmp_path, pin)
    require_pinned(tmp_path, pin.upper())
    require_pinned(tmp_path, None)
    manifest.write_text('{"geoid_separation_m": 27.5}')
    with pytest.raises(ConfigError, match=r"altered or built again.*map verify"):
        require_pinned(tmp_path, pin)


def test_a_map_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"manifest\.json"):
        map_hash(tmp_path)
