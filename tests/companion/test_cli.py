"""The command line as a process: what an operator sees of wrong input and of an interrupt."""

import signal
import subprocess
import sys
import time
from importlib import metadata

import pytest
import yaml
from typer.testing import CliRunner

from companion.cli import app

MODEL = {"width": 640, "height": 480, "fx": 550, "fy": 550, "cx": 320, "cy": 240}
START_S = 120  # of a process, on a machine that compiles everything anew


@pytest.fixture
def map_cache(small_assets):
    return small_assets.map_cache


def _start(tmp_path, **changes):
    config = {
        "camera": {"source": "udp://127.0.0.1:5", "model": MODEL},
        "bridge": {"connection": "tcp:127.0.0.1:9"},
        "record": {"folder": str(tmp_path / "record")},
    }
    path = tmp_path / "companion.yaml"
    path.write_text(yaml.safe_dump(config | changes))
    return subprocess.Popen(
        [sys.executable, "-m", "companion", "run", str(path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def _ended(process):
    out, err = process.communicate(timeout=START_S)
    assert "Traceback" not in out + err
    return process.returncode, err.strip()


@pytest.mark.parametrize("source", ["nothing.mp4", "http://x"])
def test_a_part_that_fails_on_the_way_up_leaves_no_thread_behind(map_cache, tmp_path, source):
    camera = {"source": source, "model": MODEL}
    code, text = _ended(_start(tmp_path, map=str(map_cache), camera=camera))
    assert code == 2
    assert text.startswith("StreamOpenError: ")
    assert len(text.splitlines()) == 1
    assert not (tmp_path / "record").exists()


def test_markup_in_a_message_is_shown_as_it_is(tmp_path):
    code, text = _ended(_start(tmp_path, map="[/red]nowhere"))
    assert code == 2
    assert "[/red]nowhere: no tile cache here" in text


@pytest.mark.parametrize("ready", ["record", "record/health.json"])
def test_an_interrupt_ends_it_cleanly_at_any_moment(map_cache, tmp_path, ready):
    """On the way up (the record's folder is made before compilation), and when it runs."""
    process = _start(tmp_path, map=str(map_cache))
    deadline = time.monotonic() + START_S
    while not (tmp_path / ready).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    code, _ = _ended(process)
    assert code in ((0,) if ready.endswith("json") else (0, 130))
    if code == 130:
        assert not (tmp_path / "record").exists()


def test_a_folder_that_cannot_be_made_is_one_line(map_cache, tmp_path):
    (tmp_path / "file").touch()
    bridge = {"connection": "tcp:127.0.0.1:9", "tlog": str(tmp_path / "file" / "flight.tlog")}
    code, text = _ended(_start(tmp_path, map=str(map_cache), bridge=bridge))
    assert code == 2
    assert "file" in text
    assert len(text.splitlines()) == 1


def test_an_interrupt_during_the_imports_ends_it_without_a_word():
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "companion", "--help"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    before = next(line for line in process.stderr if "numpy" in line)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=START_S)
    assert process.returncode == 130
    assert out == ""
    assert "Traceback" not in before + err


def test_the_version_is_that_of_the_package():
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.output.strip() == f"companion {metadata.version('pilot-companion')}"


@pytest.mark.parametrize(
    "options",
    [("--out", "view"), ("--width", "0"), ("--image-height", "1000000"), ("--fov", "200")],
)
def test_a_picture_of_the_map_that_cannot_be_made_is_wrong_usage(map_cache, options):
    place = ("--latitude", "47.5", "--longitude", "8.5", "--height", "500")
    result = CliRunner().invoke(app, ["map", "render", str(map_cache), *place, *options])
    assert result.exit_code == 2
    assert options[0] in result.output
