"""Positions of flights inside their protection level: what was withheld was not believed."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from benchmarks.protection.__main__ import main
from benchmarks.protection.flights import FlownPositions, Position, read_flight, report, share
from mavlink_bridge.errors import TlogError
from mavlink_bridge.link.tlog import TlogRecorder

BEGIN_NS = 37_456_555_000_000
STEP_NS = 125_000_000
ESTIMATES = "exposure_time_ns,east_m,north_m,up_m,accepted,hpl_m,vpl_m\n"
FRAMES = "exposure_time_ns,sequence,east_m,north_m,up_m,true_time_ns\n"


def flown(folder: Path, *, late_ns: int = 0, sent: int = 4) -> Path:
    """Ten frames at 8 m/s to the east; the first `sent` of eight estimates were injected.

    late_ns: by which the stamps of the pictures are late.
    """
    record = folder / "companion"
    record.mkdir(parents=True)
    frames, estimates = FRAMES, ESTIMATES
    for k in range(10):
        true_ns = BEGIN_NS + k * STEP_NS
        frames += f"{true_ns + late_ns},{k},{float(k)},0.0,80.0,{true_ns}\n"
        if 0 < k < 9:
            # One that was refused, one without a level, and the others 0.1 m off to the north.
            accepted, level = ("0", "1.5") if k == 7 else ("1", "" if k == 8 else "1.5")
            row = (true_ns + late_ns, float(k), 0.1, 80.2, accepted, level, level)
            estimates += ",".join(map(str, row)) + "\n"
    (folder / "frames.csv").write_text(frames)
    (record / "estimates.csv").write_text(estimates)
    recorder = TlogRecorder(folder / "flight.tlog", lambda _: None)
    recorder.start()
    codec = mavlink.MAVLink(None, 1, 197)
    for k in range(1, 1 + sent):
        usec = (BEGIN_NS + k * STEP_NS + late_ns) // 1000
        message = mavlink.MAVLink_vision_position_estimate_message(usec, 0, 0, 0, 0, 0, 0)
        recorder.write(message.pack(codec), time.time_ns() // 1000)
    recorder.close()
    return folder


def test_what_was_injected_is_told_from_what_was_not(tmp_path: Path) -> None:
    found = read_flight(flown(tmp_path / "embedded-normal-fast-3"))
    assert found.normal
    assert [p.injected for p in found.positions] == [True] * 4 + [False] * 2
    for position in found.positions:
        assert list(position.error_m) == pytest.approx([0.1, 0.2], abs=1e-3)


def test_late_stamps_are_errors_of_the_way_flown_meanwhile(tmp_path: Path) -> None:
    """By the stamped times the pictures would agree with themselves."""
    found = read_flight(flown(tmp_path / "embedded-late-300ms-5", late_ns=125_000_000))
    assert not found.normal
    assert found.positions[0].error_m[0] == pytest.approx(1.005, abs=1e-3)


def of(error_m: float, *, injected: bool = True) -> Position:
    return Position(0, (error_m, 0.0), (1.5, 2.0), injected)


def test_a_withheld_position_that_is_wrong_spoils_no_share() -> None:
    good = FlownPositions("a-normal-fast-1", True, (of(0.2), of(0.3)))
    frozen = FlownPositions("a-frozen-hover-5", False, (of(0.1), of(30.0, injected=False)))
    found = report([good, frozen])["shares"]
    assert (found["all, injected"]["within_hpl"], found["all, injected"]["positions"]) == (3, 3)
    assert found["all, not injected"]["within_hpl"] == 0
    assert found["all, not injected"]["worst_share"] == pytest.approx(20.0)
    assert "normal, not injected" not in found
    late = FlownPositions("a-late-300ms-5", False, (of(0.1), of(3.0)))
    counted = share([good, late], injected=True)
    assert counted is not None
    assert (counted.flights, counted.flights_whole, counted.within_hpl) == (2, 1, 3)
    assert counted.low < 75.0 < counted.high


def test_what_cannot_be_counted_is_named_and_the_rest_is_written(tmp_path, monkeypatch, capsys):
    flight = flown(tmp_path / "embedded-normal-fast-3")
    shifted = flown(tmp_path / "ardupilot-map-shifted-15m-5")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(TlogError, match="shifted"):
        read_flight(shifted)
    out = tmp_path / "flights.json"
    arguments = ["protection", "--flights", *map(str, (flight, shifted, empty)), "--out", str(out)]
    monkeypatch.setattr("sys.argv", arguments)
    main()
    found = json.loads(out.read_text())["more"]
    assert found["shares"]["normal, injected"]["positions"] == 4
    assert set(found["left_out"]) == {shifted.name, "empty"}
    assert "| normal, injected | 1, 1 whole | 4 of 4" in capsys.readouterr().out
