"""A deployment file from questions: short, valid, and true to the schema's defaults."""

import json
import re
import resource

import cv2
import numpy as np
import pytest
import yaml
from pydantic import BaseModel
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.config import CompanionConfig, load_config, parse_config
from companion.errors import ConfigError
from companion.preflight.map_pin import map_hash
from companion.settings_file import settable_fields
from companion.setup.write import differing_settings, reference
from localizer.errors import MapCacheError
from tests.companion.test_config import DEPLOYMENT, MINIMAL, MODEL

EXAMPLES = {"map", "camera.source", "bridge.connection", "record.folder"}


@pytest.fixture
def video(tmp_path):
    """A folder of two pictures of 640 x 480."""
    folder = tmp_path / "video"
    folder.mkdir()
    for k in range(2):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((480, 640, 3), 90 * k, np.uint8))
    return folder


def paths(data, where=""):
    for key, value in data.items():
        here = f"{where}{key}"
        if isinstance(value, dict):
            yield from paths(value, here + ".")
        else:
            yield here


def test_only_what_differs_is_kept_and_nothing_is_lost():
    given = MINIMAL | {
        "bridge": {"injection": {"rate_hz": 10.0}},
        "localizer": {"calibration": {"stamp_ms": 1.5}},
        "console": {"listen": "127.0.0.1:8081"},
    }
    config = parse_config(given, "test")
    kept = differing_settings(config)
    assert set(paths(kept)) == {
        "map", "camera.source", *(f"camera.model.{k}" for k in MODEL),
        "bridge.injection.rate_hz", "localizer.calibration.stamp_ms", "console.listen",
    }  # fmt: skip
    assert parse_config(kept, "again") == config


def test_the_reference_is_a_valid_deployment_of_true_defaults():
    config = parse_config(yaml.safe_load(reference()), "reference")
    own = set(paths(differing_settings(config)))
    assert own == {"map", "camera.source", *(f"camera.model.{k}" for k in (
        "width", "height", "fx", "fy", "cx", "cy"))}  # fmt: skip
    text = reference()

    def names(model: type[BaseModel]) -> set[str]:
        return set(settable_fields(model))

    assert all(f"{name}:" in text for name in names(CompanionConfig))
    assert "delay_ms: 100.0" in text
    assert "# age at which a fix is sent" in text


def test_the_shipped_deployment_file_differs_from_the_defaults_in_its_examples_only():
    shipped = set(paths(differing_settings(load_config(DEPLOYMENT))))
    assert {p for p in shipped if not p.startswith("camera.model.")} == EXAMPLES


def test_map_and_stream_are_asked_and_a_silent_vehicle_is_noted(
    terrain, video, tmp_path, monkeypatch
):
    monkeypatch.setattr("mavlink_bridge.preflight.client._CONNECT_S", 0.2)
    out = tmp_path / "deployment.yaml"
    answers = f"{terrain.path}\n{video}\nudpin:127.0.0.1:0\ngimbal\n60\n"
    done = CliRunner().invoke(app, ["init", str(out)], input=answers)
    assert done.exit_code == 0, done.output
    config, text = load_config(out), out.read_text()
    assert (config.camera.model.width, config.camera.model.height) == (640, 480)
    assert config.camera.model.fx == pytest.approx(320 / np.tan(np.radians(30)))
    assert config.map == terrain.path
    assert config.map_sha256 == map_hash(terrain.path)
    assert config.bridge.mode == "shadow"
    assert "no vehicle was heard" in text
    assert "not a calibration" in text
    assert "is assumed" not in text
    assert len(text.splitlines()) < 25
    again = CliRunner().invoke(app, ["init", str(out)], input=answers)
    assert again.exit_code != 0
    assert out.read_text() == text


def test_where_nobody_answers_the_option_is_named(terrain, tmp_path):
    """In a script it ended with "Aborted." before."""
    words = ["init", str(tmp_path / "d.yaml"), "--map", str(terrain.path), "--source", "a",
             "--no-listen", "--connection", "udpin:127.0.0.1:14551", "--fov", "60"]  # fmt: skip
    done = CliRunner().invoke(app, words, input="")
    assert isinstance(done.exception, ConfigError)
    assert "camera mount (gimbal, fixed): nobody answers here; give --mount" in str(done.exception)


def test_a_calibration_of_another_size_is_told(terrain, video, tmp_path):
    lens = tmp_path / "camera.json"
    lens.write_text(json.dumps(MODEL | {"width": 1280, "cx": 640}))
    out = tmp_path / "d.yaml"
    done = CliRunner().invoke(
        app,
        ["init", str(out), "--map", str(terrain.path), "--source", str(video), "--camera",
         str(lens), "--connection", "udpin:127.0.0.1:14551", "--mount", "fixed", "--no-listen"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    config = load_config(out)
    assert config.camera.model.fx == 550
    assert (config.bridge.camera.mount, config.bridge.camera.mount_pitch_deg) == ("fixed", -90.0)


@pytest.mark.parametrize("given", [[], ["--map", "not/there"]])
def test_without_a_map_a_file_is_written_that_says_what_is_missing(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    words = ["init", "d.yaml", *given, "--source", "a", "--no-listen", "--connection",
             "udpin:127.0.0.1:14551", "--fov", "60", "--mount", "gimbal"]  # fmt: skip
    done = CliRunner().invoke(app, words, input="")
    assert done.exit_code == 0, done.output
    assert "NO MAP YET" in done.output
    assert "next: the map, then companion doctor" in done.output
    place = given[1] if given else "maps/area"
    assert f"--out {place}" in (tmp_path / "d.yaml").read_text()
    config = load_config(tmp_path / "d.yaml")
    assert (config.map, config.map_sha256) == (tmp_path / place, None)
    assert "1280x720 is assumed: check width, height" in done.output


def test_a_full_disk_leaves_the_old_file_and_names_the_new_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d.yaml").write_text("old")
    words = ["init", "d.yaml", "--overwrite", "--map", "none", "--source", "a", "--no-listen",
             "--connection", "udpin:127.0.0.1:14551", "--fov", "60",
             "--mount", "fixed"]  # fmt: skip
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))  # each write fails
    try:
        done, key = (CliRunner().invoke(app, given) for given in (words, ["key", "k.key"]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert re.match("d.yaml: cannot be written", str(done.exception))
    assert (tmp_path / "d.yaml").read_text() == "old"
    assert re.match("k.key: cannot be written", str(key.exception))
    assert [p.name for p in tmp_path.iterdir()] == ["d.yaml"]  # no empty key, no part of a file


def test_something_else_in_the_maps_place_is_refused(tmp_path):
    words = ["init", str(tmp_path / "d.yaml"), "--map", str(tmp_path), "--source", "a"]
    done = CliRunner().invoke(app, words)
    assert isinstance(done.exception, MapCacheError)
    assert not (tmp_path / "d.yaml").exists()
