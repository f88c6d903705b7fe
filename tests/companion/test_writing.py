"""A result never replaces what was given to be read."""

import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import FootageError, ReportError
from companion.recorded.autopilot_log import read_autopilot_log
from companion.writing import refuse_input, result_file
from localizer.geometry.posefile import read_poses


def test_a_result_is_no_input_has_its_suffix_and_lies_beside_a_cache(tmp_path):
    given, cache = tmp_path / "a.json", tmp_path / "cache"
    given.write_text("{}")
    cache.mkdir()
    (cache / "index.safetensors").touch()
    with pytest.raises(ReportError, match="would replace"):
        result_file(given, "--json", (".json",), given)
    with pytest.raises(ReportError, match=r"ends in \.json"):
        result_file(tmp_path / "flight.bin", "--json", (".json",))
    with pytest.raises(ReportError, match="in a tile cache"):
        result_file(cache / "manifest.json", "--geojson", (".geojson", ".json"))
    assert result_file(tmp_path / "new.json", "--json", (".json",), given, None)
    refuse_input(tmp_path / "new.json", "--out", given)


def test_localize_keeps_its_priors(small_assets, small_sequence, tmp_path):
    shutil.copy(small_sequence / "poses.txt", tmp_path)
    name = read_poses(tmp_path / "poses.txt")[0].name
    found = CliRunner().invoke(app, [
        "localize", str(small_sequence / "images" / name), "--map", str(small_assets.map_cache),
        "--camera", str(small_sequence / "camera.json"), "--priors", str(tmp_path / "poses.txt"),
        "--out", str(tmp_path),
    ])  # fmt: skip
    assert isinstance(found.exception, ReportError)
    assert (tmp_path / "poses.txt").read_text() == (small_sequence / "poses.txt").read_text()


@pytest.mark.parametrize(
    "command",
    ["map export area --out area/index.safetensors", "self-test --out area/manifest.json",
     "convert poses.txt area/manifest.json --from poses --to tum",
     "convert poses.txt poses.txt --from poses --to poses", "convert . . --from photos --to photos",
     "map raise dsm.tif fp.json --out dsm.tif", "map raise dsm.tif fp.json --out fp.json",
     "try photos --places r/frames.csv --report r", "doctor pg.txt --page pg.html",
     "try r --report r", "eval r --map area --report r", "klv a.ts --record r --out a.ts",
     "calibrate flight r --json r/record.json", "calibrate flight r --config d.json --json d.json",
     "calibrate board --print area/board.pdf", "map info area --kml area/a.kml"],
)  # fmt: skip
def test_a_command_replaces_none_of_its_inputs(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("companion.cli.doctor.load_config", lambda _path: None)
    for name in ("area/index.safetensors", "area/manifest.json", "poses.txt", "dsm.tif", "fp.json",
                 "r/frames.csv", "pg.txt", "photos/a.jpg", "r/record.json", "d.json",
                 "a.ts"):  # fmt: skip
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("kept")
    found = CliRunner().invoke(app, command.split())
    assert isinstance(found.exception, ReportError)
    assert re.search("would replace|lies in a tile cache", str(found.exception))
    assert {path.read_text() for path in tmp_path.rglob("*.*") if path.is_file()} == {"kept"}


@pytest.mark.parametrize(
    ("content", "why"), [(bytes(3000), "begins with 00 00"), (b"", "is empty")]
)
def test_what_is_no_dataflash_log_is_named_in_one_line(tmp_path, capfd, content, why):
    log = tmp_path / "z.bin"
    log.write_bytes(content)
    with pytest.raises(FootageError, match=why):
        read_autopilot_log(log, None)
    assert capfd.readouterr().err == ""
