"""Recorded flights through the monitor of now."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from benchmarks.protection.__main__ import main
from benchmarks.protection.replayed import replay
from mavlink_bridge.errors import TlogError
from mavlink_bridge.link.tlog import TlogRecorder
from mavlink_bridge.vehicle.origin import offset

UTC_NS, BEGIN_NS = 1_795_379_416_000_000_000, 54_349_000_000_000
SECONDS = 12
HEAD = (
    "exposure_time_ns,latitude_deg,longitude_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m,"
    "state,accepted,latency_ms,hpl_m"
)


def recorded(folder: Path, *, aside_m: float = 0.0) -> Path:
    """5 m/s northwards for 12 s, 50 m up; vision is aside from 6 to 9 s, without announcing it."""
    companion = folder / "companion"
    companion.mkdir(parents=True)
    made = {"monotonic_ns": BEGIN_NS, "utc_ns": UTC_NS}
    (companion / "record.json").write_text(json.dumps(made))
    rows, rng = [HEAD], np.random.default_rng(1)
    for tenth in range(10 * SECONDS):
        at_s = 0.1 * tenth
        north, east = 0.05 * rng.standard_normal(2) + (5.0 * at_s, aside_m * (60 <= tenth < 90))
        latitude, longitude = offset(47.4, 8.5, float(north), float(east))
        row = (
            BEGIN_NS + round(at_s * 1e9), f"{latitude:.9f}", f"{longitude:.9f}", 535.0,
            0.1, 0.1, 0.1, "tracking", 1, 50.0, 1.5,
        )  # fmt: skip
        rows.append(",".join(map(str, row)))
    (companion / "estimates.csv").write_text("\n".join(rows) + "\n")
    _vehicle(folder / "flight.tlog")
    return folder


def _vehicle(path: Path) -> None:
    """Heartbeat, place and velocity, ten a second."""
    recorder = TlogRecorder(path, lambda _: None)
    recorder.start()
    codec = mavlink.MAVLink(None, 1, 1)
    for tenth in range(10 * SECONDS + 10):
        boot_ms, utc_us = 60_000 + 100 * tenth, (UTC_NS + tenth * 100_000_000) // 1000
        north = 0.5 * tenth
        for message in (
            mavlink.MAVLink_heartbeat_message(2, 3, 0x81, 4, 4, 3),
            mavlink.MAVLink_local_position_ned_message(boot_ms, north, 0.0, -50.0, 5.0, 0.0, 0.0),
            mavlink.MAVLink_global_position_int_message(
                boot_ms, 474000000, 85000000, 538000, 50000, 500, 0, 0, 0
            ),
        ):
            recorder.write(message.pack(codec), utc_us)
    recorder.close()


def test_an_honest_flight_is_quiet_and_its_level_is_what_its_sources_make(tmp_path: Path) -> None:
    found = replay(recorded(tmp_path / "embedded-normal-fast-3"))
    assert (found.fixes, found.held, found.widened, found.told) == (120, 0, 0, {})
    # sigma 0.1, map 0.28, 0.3 % of 50 m, 10 ms at 5 m/s
    assert found.hpl_m == pytest.approx(3.717 * np.sqrt(0.01 + 0.0784 + 0.0225 + 0.0025), rel=0.01)
    assert found.shares["map"] == pytest.approx(0.691, abs=0.01)
    assert sum(found.shares.values()) == pytest.approx(1.0, abs=0.02)


def test_a_jump_is_withheld_and_told_by_the_guardian_of_now(tmp_path: Path) -> None:
    found = replay(recorded(tmp_path / "embedded-jump-3", aside_m=12.0))
    assert 30 <= found.held <= 32
    assert found.told == {"position_jump": 1}


def test_what_cannot_be_replayed_is_named_and_the_rest_is_written(tmp_path, monkeypatch, capsys):
    flight, empty = recorded(tmp_path / "embedded-normal-fast-3"), tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(TlogError, match="empty"):
        replay(empty)
    out = tmp_path / "replayed.json"
    arguments = ["protection", "--replay", str(flight), str(empty), "--out", str(out)]
    monkeypatch.setattr("sys.argv", arguments)
    main()
    found = json.loads(out.read_text())
    assert [one["flight"] for one in found["replayed"]] == [flight.name]
    assert set(found["left_out"]) == {str(empty)}
    assert "| 1 flights, 1 quiet | 120 | 0 |" in capsys.readouterr().out
