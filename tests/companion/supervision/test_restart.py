"""A restart in the air goes on though a disk went meanwhile; a first start says what is wrong."""

from __future__ import annotations

import errno
import threading
from pathlib import Path

import pytest

from companion.config import CompanionConfig, parse_config
from companion.supervision.restart import without_lost_disks, write_problem

MODEL = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
CAMERA = {"model": MODEL, "source": "udp://x:1"}


def deployment(stick: Path, **bridge: str) -> CompanionConfig:
    data = {
        "map": "map", "camera": CAMERA, "bridge": bridge,
        "record": {"folder": str(stick / "flight")},
    }  # fmt: skip
    return parse_config(data, "here")


def test_what_can_be_written_stays_as_it_is(tmp_path: Path) -> None:
    config = deployment(tmp_path / "new", tlog=str(tmp_path / "logs" / "a.tlog"))
    assert without_lost_disks(config) == (config, "")
    assert not list((tmp_path / "new").iterdir())


def test_a_stick_that_is_gone_costs_the_record_and_not_the_flight(tmp_path: Path) -> None:
    """Its mount point is a folder of root's again, or is no more: no disk fault, and each restart
    ended with a wrong setting.
    """
    stick = tmp_path / "stick"
    stick.write_text("no folder any more")
    left, told = without_lost_disks(deployment(stick, tlog=str(stick / "a.tlog")))
    assert left.record is None
    assert left.bridge.tlog is None
    assert str(stick) in told
    # They are only read and written where that goes, and keep their names.
    assert left.state_folder == stick


def test_one_disk_of_two(tmp_path: Path) -> None:
    stick = tmp_path / "stick"
    stick.write_text("")
    left, told = without_lost_disks(deployment(tmp_path, tlog=str(stick / "a.tlog")))
    assert left.record is not None
    assert left.bridge.tlog is None
    assert told == f"{stick}: Not a directory" or str(stick) in told


def test_a_log_that_is_there_is_appended_to(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").touch()
    config = deployment(tmp_path, tlog=str(tmp_path / "a.tlog"))
    left, told = without_lost_disks(config, lambda _: "Permission denied")
    assert left.bridge.tlog == tmp_path / "a.tlog"
    assert left.record is None
    assert told == f"{tmp_path}: Permission denied"


def test_a_disk_that_stands_still_is_not_even_read(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.supervision.restart._PATIENCE_S", 0.05)
    still = threading.Event()

    def probe(folder: Path) -> str:
        if folder == tmp_path / "stick":
            still.wait(120.0)
        return ""

    config = deployment(tmp_path / "stick", tlog=str(tmp_path / "a.tlog"))
    left, told = without_lost_disks(config, probe)
    still.set()
    assert told == f"{tmp_path / 'stick'}: does not answer"
    assert left.record is None
    assert left.bridge.tlog == tmp_path / "a.tlog"
    assert left.state_folder is None


@pytest.mark.parametrize(
    ("number", "told"), [(errno.ENOSPC, False), (errno.EUCLEAN, False), (errno.EACCES, True)]
)
def test_a_full_or_failing_disk_is_the_recorders_to_tell(tmp_path, monkeypatch, number, told):
    def full(*_: object, **__: object) -> None:
        raise OSError(number, "as it is")

    monkeypatch.setattr("tempfile.mkstemp", full)
    assert bool(write_problem(tmp_path)) is told
