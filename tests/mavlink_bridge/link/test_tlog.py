"""The .tlog recorder: named errors at the start, degrading in flight, read back by pymavlink."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.errors import TlogError
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.link.tlog import WHOLE, TlogRecorder, read_tlog

FULL = Path("/dev/full")


def frame(i: int) -> bytes:
    codec = mavlink.MAVLink(None, 1, 1)
    codec.seq = i % 256
    message = mavlink.MAVLink_attitude_message(i, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return bytes(message.pack(codec))


def test_a_file_that_cannot_be_opened_is_a_named_error(tmp_path: Path) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("")
    for path in (occupied / "flight.tlog", tmp_path):
        with pytest.raises(TlogError, match=r"bridge\.tlog"):
            TlogRecorder(path)
        with pytest.raises(TlogError):
            Bridge(BridgeConfig(tlog=path), 0.0)


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_a_full_disk_is_told_once_and_costs_the_record_only(autopilot: Any) -> None:
    config = BridgeConfig(connection=f"udpout:127.0.0.1:{autopilot.port}", tlog=FULL)
    with Bridge(config, 0.0) as bridge:
        assert sleep_until(lambda: int(bridge.counters()["tlog_dropped"]) > 20, 30.0)
        assert sleep_until(lambda: bridge.state().connected, 30.0)
        incomplete = alert(AlertId.TLOG_INCOMPLETE, why=Name("No space left on device"))
        assert bridge.alerts().count(incomplete) == 1
        assert bridge.counters()["fc_handler_errors"] == 0


def test_a_start_on_a_failing_disk_goes_on_without_a_tlog(tmp_path, monkeypatch):
    """As after a restart in the air; a wrong path is an error all the same."""

    def refuse(number: int) -> Callable[..., None]:
        def mkdir(*_: object, **__: object) -> None:
            raise OSError(number, os.strerror(number))

        return mkdir

    monkeypatch.setattr(Path, "mkdir", refuse(errno.EACCES))
    with pytest.raises(TlogError):
        TlogRecorder(tmp_path / "x" / "a.tlog")
    monkeypatch.setattr(Path, "mkdir", refuse(errno.EROFS))
    told: list[str] = []
    recorder = TlogRecorder(tmp_path / "x" / "a.tlog", told.append)
    recorder.start()
    recorder.write(frame(1), 1)
    recorder.close()
    assert told == ["Read-only file system"]
    assert recorder.dropped == 1


def test_greatest_size_and_bounded_queue(tmp_path: Path) -> None:
    told: list[str] = []
    path = tmp_path / "a.tlog"
    first = [frame(i) for i in range(3)]
    size = sum(8 + len(f) for f in first)
    recorder = TlogRecorder(path, told.append, max_bytes=size + 20)
    recorder.start()
    for i, f in enumerate(first):
        recorder.write(f, 1_000_000 * i)
    assert sleep_until(lambda: path.stat().st_size == size, 30.0)
    for i in range(20):
        recorder.write(frame(i), 1_000_000 * i)
    recorder.close()
    assert recorder.dropped == 20
    assert told == [WHOLE]
    idle = TlogRecorder(tmp_path / "b.tlog")  # not started: as if its disk stood still
    for i in range(9000):
        idle.write(frame(i), i)
    assert idle.dropped == 9000 - 8192
    idle.close()


def test_a_disk_that_stalls_does_not_stall_the_sender(tmp_path, monkeypatch):
    writing, written, closed = threading.Event(), threading.Event(), threading.Event()
    waited_in_vain = []

    class Stalled:
        """A disk that takes nothing until the sender is through."""

        def write(self, data: bytes | bytearray, /) -> int:
            writing.set()
            if not written.wait(30.0):
                waited_in_vain.append(len(data))
            return len(data)

        def close(self) -> None:
            closed.set()

    monkeypatch.setattr(Path, "open", lambda *_, **__: Stalled())
    recorder = TlogRecorder(tmp_path / "a.tlog")
    recorder.start()
    recorder.write(frame(0), 0)
    assert writing.wait(30.0)
    for i in range(1, 100):
        recorder.write(frame(i), i)
    monkeypatch.setattr("mavlink_bridge.link.tlog._CLOSE_S", 0.1)
    recorder.close()  # nor its end; the file is still in use then
    assert not closed.is_set()
    written.set()
    monkeypatch.undo()
    recorder.close()
    assert closed.is_set()
    assert waited_in_vain == []
    assert recorder.dropped == 0


def test_mavutil_reads_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    recorder = TlogRecorder(path)
    recorder.start()
    begun = time.time()
    for i in range(200):
        recorder.write(frame(i), int((begun + 0.02 * i) * 1e6))
    recorder.close()
    log = mavutil.mavlink_connection(str(path))
    stamps = []
    while (m := log.recv_match(type="ATTITUDE")) is not None:
        stamps.append((m.time_boot_ms, log.timestamp))
    log.close()
    assert [boot for boot, _ in stamps] == list(range(200))
    assert stamps[-1][1] - begun == pytest.approx(0.02 * 199, abs=1e-3)


@pytest.mark.parametrize("kind", ["pipe", "device", "endless"])
def test_a_tlog_that_a_record_names_keeps_no_reader_waiting(tmp_path: Path, kind: str) -> None:
    path = Path("/dev/zero") if kind == "device" else tmp_path / "a.tlog"
    if kind == "pipe":
        os.mkfifo(path)
    if kind == "endless":
        with path.open("wb") as file:
            file.truncate(1 << 40)  # sparse
    with pytest.raises(TlogError, match=r"not a plain file|larger than the 2 GiB"):
        list(read_tlog(path))
