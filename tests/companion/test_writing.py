"""A result never replaces what was given to be read."""

import shutil

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
    (cache / "manifest.json").write_text("{}")
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
    ("content", "why"), [(bytes(3000), "begins with 00 00"), (b"", "is empty")]
)
def test_what_is_no_dataflash_log_is_named_in_one_line(tmp_path, capfd, content, why):
    log = tmp_path / "z.bin"
    log.write_bytes(content)
    with pytest.raises(FootageError, match=why):
        read_autopilot_log(log, None)
    assert capfd.readouterr().err == ""
