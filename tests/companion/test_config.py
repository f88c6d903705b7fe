from pathlib import Path

import pytest
import yaml

from companion.config import load_config
from companion.errors import ConfigError

MODEL = {"width": 640, "height": 480, "fx": 550, "fy": 550, "cx": 320, "cy": 240}
MINIMAL = {"map": "cache", "camera": {"source": "udp://127.0.0.1:5600", "model": MODEL}}


def _write(tmp_path: Path, data: object) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


def test_minimal_config_and_paths_relative_to_the_file(tmp_path):
    config = load_config(_write(tmp_path, MINIMAL | {"record": {"folder": "out"}}))
    assert config.map == tmp_path / "cache"
    assert config.record is not None
    assert config.record.folder == tmp_path / "out"
    assert config.camera.model.camera().fx == 550


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"mapp": "x"}, "mapp"),
        ({"localizer": {"width": "wide"}}, "localizer.width"),
        ({"localizer": {"motion": {"acceleration_sigma": -1}}}, "acceleration_sigma"),
        ({"camera": {"source": "udp://x:1", "model": MODEL | {"fx": -1}}}, "camera.model.fx"),
        ({"bridge": {"connection": "carrier-pigeon:1"}}, "bridge.connection"),
        ({"targets": {"detections": "nonsense"}}, "targets.detections"),
    ],
)
def test_every_problem_is_named_by_its_key(tmp_path, change, named):
    with pytest.raises(ConfigError, match=named) as caught:
        load_config(_write(tmp_path, MINIMAL | change))
    assert "config.yaml" in str(caught.value)


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "map: [", "\x00"])
def test_files_that_are_no_mapping(tmp_path, text):
    with pytest.raises(ConfigError):
        load_config(_write(tmp_path, text))


def test_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "none.yaml")


def test_the_shipped_deployment_file_is_complete_and_valid():
    """Every top-level key stands in it, so that an operator sees all there is to set."""
    path = Path(__file__).parents[2] / "configs" / "deployment.yaml"
    config = load_config(path)
    assert set(yaml.safe_load(path.read_text())) == set(type(config).model_fields)
    assert config.bridge.mode == "shadow"
