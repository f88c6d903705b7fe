from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from companion.config import CompanionConfig, load_config, parse_config
from companion.errors import ConfigError
from companion.settings_file import REMOVED, RENAMED, nested_models, settable_fields
from mavlink_bridge import BridgeConfig
from tests.bounds import unbounded

MODEL = {"width": 640, "height": 480, "fx": 550, "fy": 550, "cx": 320, "cy": 240}
CAMERA = {"source": "udp://127.0.0.1:5600", "model": MODEL}
MINIMAL = {"map": "cache", "camera": CAMERA}


def _write(tmp_path: Path, data: object) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


def test_minimal_config_and_paths_relative_to_the_file(tmp_path):
    targets = {"detector": {"model": "cars.onnx"}}
    given = {"record": {"folder": "out"}, "state_dir": "state", "targets": targets}
    camera = CAMERA | {"source": "film.mp4"}
    signed = {"signing": {"key_file": "fc.key"}, "tlog": "fc.tlog"}
    config = load_config(_write(tmp_path, MINIMAL | given | {"camera": camera, "bridge": signed}))
    assert config.map == tmp_path / "cache"
    assert config.record.folder == tmp_path / "out"
    assert config.state_folder == tmp_path / "state"
    assert config.targets.detector.model == tmp_path / "cars.onnx"
    assert config.camera.source == str(tmp_path / "film.mp4")
    assert config.bridge.tlog == tmp_path / "fc.tlog"
    assert config.bridge.signing.key_file == tmp_path / "fc.key"
    assert config.bridge.signing.state_file == tmp_path / "state" / "fc.key.fc.seen"
    assert config.camera.model.camera().fx == 550


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            {"camera": {"source": "a", "model": {"width": "big"}}},
            r"camera\.model\.width: must be an integer \(got 'big'\)",
        ),
        ({"mapp": "x"}, r"mapp: no such setting, did you mean map\? \(got 'x'\)"),
        (
            {"bridge": {"conection": 1}},
            r"bridge.conection: no such setting, did you mean connection\?",
        ),
        ({"zzz": 1}, r"zzz: no such setting \(got 1\)"),
        ({"localizer": {"width": "wide"}}, "localizer.width"),
        ({"camera": {**CAMERA, "source": "frames", "settings": {"sender": "127.0.0.1"}}}, "udp://"),
        ({"targets": {"rate_hz": True}}, "targets.rate_hz: must not be a boolean"),
        ({"camera": CAMERA | {"lever_arm_m": [0, True, 0]}}, r"camera.lever_arm_m.1.*\(got True"),
        ({"camera": {"source": "udp://x:1", "model": MODEL | {"fx": -1}}}, "camera.model.fx"),
        ({"bridge": {"connection": "carrier-pigeon:1"}}, "bridge.connection"),
        ({"targets": {"detections": "nonsense"}}, "targets.detections"),
        ({"bridge": {"targets": {"cot_endpoint": "nonsense"}}}, "bridge.targets.cot_endpoint"),
        ({"bridge": {"targets": {"cot_endpoint": "host:0"}}}, "write host:port"),
        ({"bridge": {"switch": {"vision_set": 1}}}, "two different source sets"),
        ({"bridge": {"rc": {"command": "user_9"}}}, "bridge.rc.command"),
        ({"bridge": {"camera_component": 197}}, "a component id each"),
        ({"bridge": {"localizer_component": 1}}, "bridge.localizer_component"),
        ({"bridge": {"connection": "tcp:h:1", "ground_connection": "tcp:h:1"}}, "leave it empty"),
        ({"bridge": {"connection": "tcp:host:0"}}, "0 is no port number"),
        ({"bridge": {"connection": "serial:/dev/ttyS0:99999999999"}}, "no baud rate"),
        ({"localizer": {"threads": 10**9}}, "localizer.threads"),
        ({"localizer": {"cache_mib": 10**9}}, "localizer.cache_mib"),
        ({"targets": {"rate_hz": float("inf")}}, "targets.rate_hz"),
        ({"camera": CAMERA | {"lever_arm_m": [0, float("nan"), 0]}}, "camera.lever_arm_m.1"),
        ({"camera": CAMERA | {"lever_arm_m": [120, 0, 0]}}, "camera.lever_arm_m.0"),
        ({"camera": CAMERA | {"model": MODEL | {"fx": 0.86}}}, "camera.model: .*fx 0.86 on 640"),
        ({"camera": CAMERA | {"model": MODEL | {"fy": 550e3}}}, "give the focal length in pixels"),
        ({"camera": CAMERA | {"model": MODEL | {"cx": 0.5}}}, "camera.model: .*cx 0.5 is far"),
        ({"camera": CAMERA | {"model": MODEL | {"fy": 1650}}}, "fx 550 and fy 1650 are of pixels"),
        ({"camera": CAMERA | {"model": MODEL | {"cy": 3600}}}, "principal point in pixels"),
        ({"camera": CAMERA | {"model": MODEL | {"distortion": [9, 0, 0, 0, 0]}}}, "the order of"),
        ({"camera": CAMERA | {"model": MODEL | {"distortion": [0, 0, 9, 0, 0]}}}, "the order of"),
        (
            {"camera": CAMERA | {"model": MODEL | {"distortion": [0, 0, 0, 0, 0, 9]}}},
            "has 5, 8, 12",
        ),
        ({"targets": {"rate_hz": 1e-300}}, "targets.rate_hz"),
        ({"camera": CAMERA | {"settings": {"rate_hz": 1e-300}}}, "camera.settings.rate_hz"),
        ({"record": {"folder": "f", "snapshot_interval_s": 1e300}}, "snapshot_interval_s"),
        ({"map": ""}, "map: '.' names no file"),
        ({"record": {"folder": ""}}, "record.folder: '.' names no file"),
        ({"bridge": {"tlog": "a\0b"}}, "bridge.tlog: 'a.x00b' names no file"),
        ({"bridge": {"signing": {"key_file": ""}}}, "bridge.signing.key_file: '.' names no file"),
    ],
)
def test_every_problem_is_named_by_its_key(tmp_path, change, named):
    with pytest.raises(ConfigError, match=named) as caught:
        load_config(_write(tmp_path, MINIMAL | change))
    assert "config.yaml" in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "", "- a\n- b\n", "map: [", "\x00", "map: 2026-13-41", "map: " + 500 * "[",
        "map: !!bool x", "map: !!timestamp x", "map: !!int ''",
    ],
)  # fmt: skip
def test_files_that_are_no_mapping(tmp_path, text):
    with pytest.raises(ConfigError):
        load_config(_write(tmp_path, text))


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("none.yaml", "No such file"),
        ("/dev/zero", "is not a plain file"),  # it has no end
        ("flight.log", "is larger than 1 MiB"),  # given by mistake
    ],
)
def test_what_is_no_settings_file_is_not_read_to_its_end(tmp_path, name, why):
    with (tmp_path / "flight.log").open("wb") as file:
        file.truncate(1 << 40)  # sparse
    with pytest.raises(ConfigError, match=f"cannot be read: {why}"):
        load_config(tmp_path / name)


def test_merged_mappings_that_multiply_are_refused(tmp_path):
    lines = ["a0: &a0 {x: 1}"]
    for i in range(1, 12):
        lines.append(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}")
    with pytest.raises(ConfigError, match="the merge key << is not read"):
        load_config(_write(tmp_path, "\n".join(lines)))


def test_aliases_that_multiply_do_not_multiply_the_error(tmp_path):
    """Printed in full, the last line would be 9^9 words."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join(9 * [f'*a{i - 1}'])}]" for i in range(1, 10)]
    with pytest.raises(ConfigError, match="a9: no such setting") as caught:
        load_config(_write(tmp_path, "\n".join(lines)))
    assert len(str(caught.value)) < 2000


def test_the_mode_off_needs_no_quotes(tmp_path):
    """YAML reads off as false."""
    text = yaml.safe_dump(MINIMAL) + "bridge:\n  mode: off\n"
    assert load_config(_write(tmp_path, text)).bridge.mode == "off"
    with pytest.raises(ConfigError, match=r"bridge\.mode: "):
        load_config(_write(tmp_path, text.replace("off", "on")))


DEPLOYMENT = Path(__file__).parents[2] / "configs" / "deployment.yaml"


def _keys(model: type[BaseModel], where: str = "") -> Iterator[tuple[str, ...]]:
    """Paths of all keys of a configuration, those of nested and optional models, too."""
    for name, field in settable_fields(model).items():
        yield (*filter(None, where.split(".")), name)
        for nested in nested_models(field.annotation):
            yield from _keys(nested, f"{where}{name}.")


def test_there_are_few_keys():
    """A user sets what he knows; constants of the algorithms are code."""
    parts = {path[:n] for path in _keys(CompanionConfig) for n in range(1, len(path))}
    assert len([path for path in _keys(CompanionConfig) if path not in parts]) <= 120


def test_the_shipped_deployment_file_lists_every_key_and_is_valid():
    text = DEPLOYMENT.read_text()
    config = load_config(DEPLOYMENT)
    assert config.bridge.mode == "shadow"
    written = yaml.safe_load(text)
    for path in _keys(type(config)):
        place, told = written, True
        for depth, key in enumerate(path):
            if place is None:  # an optional part that is off: its keys stand in the comment
                line = re.split(rf"\s{path[depth - 1]}: null", text, maxsplit=1)[1][:300]
                told = f"{key}:" in line
                break
            told = told and key in place
            assert told, ".".join(path)
            place = place[key]
        assert told, ".".join(path)


def test_the_signed_example_is_valid_and_leaves_no_door_open():
    config = load_config(DEPLOYMENT.with_name("signed.yaml"))
    assert config.camera.settings.sender is not None
    assert config.bridge.sender is not None
    assert config.bridge.signing is not None
    assert config.bridge.ground_signing is not None
    assert "0.0.0.0" not in config.camera.source + config.bridge.connection


def test_every_key_of_the_bridge_is_explained_where_it_stands():
    lines = DEPLOYMENT.read_text().splitlines()
    begun = lines.index("bridge:")
    ended = lines.index("targets:")
    plain = [line for line in lines[begun + 1 : ended] if line.strip() and "#" not in line]
    assert [line.strip() for line in plain] == [
        f"{part}:" for part in ("injection", "camera", "targets")
    ]


def test_the_deployment_file_shows_the_defaults_or_says_so():
    """An operator who deletes a line must know what follows."""
    config, text = load_config(DEPLOYMENT), DEPLOYMENT.read_text()
    default = BridgeConfig()
    for part in ("injection", "switch", "rc", "camera", "targets"):
        shown, kept = getattr(config.bridge, part), getattr(default, part)
        for name in settable_fields(type(shown)):
            if getattr(shown, name) != getattr(kept, name):
                assert f"default {getattr(kept, name):g}" in text.split(f" {name}:", 1)[1][:80], (
                    name
                )


def test_every_number_has_its_bounds():
    lens = {"fx", "fy", "cx", "cy", "distortion"}  # judged together, as a lens
    keys = {".".join(path) for path in _keys(CompanionConfig)}
    assert unbounded(CompanionConfig) & keys == {f"camera.model.{name}" for name in lens}


# --- Settings under the names that they had in 0.1: read, with a warning ------------------------


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
