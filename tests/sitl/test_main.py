"""``python -m sitl``: nothing of the user's is removed or written over."""

import pytest
from typer.testing import CliRunner

from sitl import __main__ as cli
from sitl.demo.scenario import ScenarioError
from sitl.vehicles.launch import ArduPilotNotFoundError


@pytest.fixture(autouse=True)
def no_work(monkeypatch):
    """Refusals come before a world is built or flown; an accepted folder gets as far as flying."""

    class World:
        size_m = 1600.0

    class Assets:
        world = World()

    def fly(*_):
        raise RuntimeError("flying")

    monkeypatch.setattr(cli, "prepare", lambda *_: Assets())
    monkeypatch.setattr(cli, "fly", fly)


def _run(*arguments):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments], catch_exceptions=False)


@pytest.mark.parametrize("command", ["demo", "sequence"])
def test_a_file_and_a_folder_with_other_files_are_left_alone(tmp_path, command):
    out, file = tmp_path / "mine", tmp_path / "mine.tex"
    out.mkdir()
    (out / "companion.yaml").touch()  # an operator may well have one of his own
    for path in (out / "thesis.tex", file):
        path.touch()
    for given in (out, file):
        with pytest.raises(ScenarioError, match=given.name):
            _run(command, *(["--out", given] if command == "demo" else [given]))
    assert (out / "thesis.tex").exists()


def test_an_earlier_report_is_replaced(tmp_path):
    (tmp_path / "report" / "companion").mkdir(parents=True)
    (tmp_path / "report" / "report.html").touch()
    with pytest.raises(RuntimeError, match="flying"):
        _run("demo", "--out", tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_the_injection_is_named_and_reaches_the_flight(tmp_path, monkeypatch):
    flown = []
    monkeypatch.setattr(cli, "fly", lambda _, script, *__: flown.append(script) or 1 / 0)
    refused = _run("demo", "--injection", "vision")
    assert refused.exit_code == 2
    assert "'vision' is not one of" in refused.output
    with pytest.raises(ZeroDivisionError):
        _run("demo", "--injection", "odometry", "--out", tmp_path / "report")
    assert flown[0].injection == "odometry"


def test_a_missing_autopilot_is_told_before_a_world_is_generated(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "prepare", lambda *_: 1 / 0)
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("ARDUPILOT_HOME", raising=False)
    with pytest.raises(ArduPilotNotFoundError):
        _run("demo", "--fc", "ardupilot", "--out", tmp_path / "report")
