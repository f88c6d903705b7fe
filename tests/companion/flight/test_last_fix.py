"""A restart in the air goes on from the last place, if it is young and the EKF knows the way."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.conversions import CameraExtrinsics
from companion.flight.last_fix import FixMemory, LastFix, read_last_fix
from companion.flight.priors import local_near
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.types import PoseEstimate
from mavlink_bridge.link.clock import boot_id
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import Origin, VehicleState
from tests.companion.estimates import DOWN, estimated

FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
INSTALLATION = CameraExtrinsics(FRAME, 47.0, np.zeros(3))
AUTOPILOT: Any = SimpleNamespace(rotation=lambda _: DOWN, velocity=np.array([1.0, 0.0, 0.0]))
SECOND = 10**9
BEGUN = LastFix(boot_id(), 100 * SECOND, 47.0, 8.0, 580.0, 0.3, (10.0, 20.0, -80.0))


def kept(tmp_path: Path, fix: LastFix = BEGUN) -> Path:
    path = tmp_path / "last-fix.json"
    path.write_text(json.dumps(asdict(fix)))
    path.chmod(0o600)
    return path


def memory(
    path: Path,
    local: tuple[float, float, float] | None = (13.0, 24.0, -85.0),
    state: VehicleState | None = None,
) -> FixMemory:
    return FixMemory(
        path, AUTOPILOT, INSTALLATION, lambda _: local, state=lambda: state or VehicleState()
    )


@pytest.fixture(autouse=True)
def written_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.flight.last_fix._WRITE_S", 0.01)


def tracked(time_ns: int) -> PoseEstimate:
    return estimated(Pose(DOWN, np.array([5.0, 6.0, 80.0])), time_ns, variance=0.04)


def test_the_way_that_the_ekf_flew_since_is_added(tmp_path: Path) -> None:
    prior = memory(kept(tmp_path)).prior(103 * SECOND)
    # 3 m north, 4 m east, 5 m up: the map's axes are east, north, up.
    assert prior.world_from_camera.translation == pytest.approx([4.0, 3.0, 85.0], abs=0.01)
    assert prior.independent  # it begins tracking without a search
    sigma = float(np.sqrt(prior.covariance[0, 0]))
    assert 0.5 < sigma < 2.0


@pytest.mark.parametrize(("ahead_s", "usable"), [(0.0, True), (0.2, True), (0.4, False)])
def test_a_picture_that_is_newer_than_the_ekf_report_can_be_placed(tmp_path, ahead_s, usable):
    """Killed on the embedded vehicle: positions came at 10 Hz, pictures were 70 ms old, and the
    last place was never used: 3 s on trial instead.
    """
    state = VehicleState(
        local_position_ned=(13.0, 24.0, -85.0),
        local_velocity_ned=(5.0, 0.0, 0.0),
        local_time_ns=103 * SECOND,
    )
    autopilot: Any = SimpleNamespace(state=lambda: state, local_at=lambda _: None)
    path = kept(tmp_path)
    about = FixMemory(path, AUTOPILOT, INSTALLATION, lambda t: local_near(autopilot, t))
    prior = about.prior(103 * SECOND + round(ahead_s * SECOND))
    assert (prior is not None) is usable
    if prior is not None:
        north = prior.world_from_camera.translation[1]
        assert north == pytest.approx(3.0 + 5.0 * ahead_s, abs=0.01)


ORIGIN = Origin(47.0, 8.0, 453.0)
MINUTE = 60 * SECOND


@pytest.mark.parametrize(
    ("offset_ns", "origin", "usable"),
    [
        (100 * SECOND - MINUTE, ORIGIN, True),  # the autopilot a minute old at the last fix
        (100 * SECOND - MINUTE + SECOND // 2, None, True),  # its clock is not measured so well
        (103 * SECOND - SECOND // 10, None, False),  # it booted between the two processes
        (None, Origin(47.001, 8.0, 453.0), False),
        (None, Origin(47.0, 8.0, 500.0), False),
        (None, None, True),
    ],
)
def test_an_ekf_that_counts_from_elsewhere_shows_no_way(tmp_path, offset_ns, origin, usable):
    """An autopilot that rebooted while this process was away is where it began, by itself: the
    place was off by the way between, up to 40 m/s times the gap, and not on trial.
    """
    fix = replace(BEGUN, autopilot_ns=MINUTE, origin=(47.0, 8.0, 453.0))
    state = VehicleState(clock_offset_ns=offset_ns, origin=origin)
    again = memory(kept(tmp_path, fix), state=state)
    assert (again.prior(103 * SECOND) is not None) is usable
    assert memory(kept(tmp_path)).prior(103 * SECOND) is not None  # a file of an older version


def test_a_flight_that_does_not_end_in_order_leaves_its_place(tmp_path: Path) -> None:
    """A restart that fails on the way up had removed it: the next one searched the map."""
    path = kept(tmp_path)
    failing = memory(path)
    failing.start()
    failing.hand_over()
    failing.stop()
    assert memory(path).prior(103 * SECOND) is not None
    ending = memory(path)
    ending.start()
    ending.stop()
    assert not path.exists()


@pytest.mark.parametrize(
    ("at_s", "local"),
    [
        (121.0, (10.0, 20.0, -80.0)),  # too old
        (99.0, (10.0, 20.0, -80.0)),  # of the future
        (103.0, None),  # no way known
        (103.0, (510.0, 20.0, -80.0)),  # the EKF jumped
    ],
)
def test_what_may_not_be_trusted_is_not_used(tmp_path, at_s, local):
    assert memory(kept(tmp_path), local).prior(round(at_s * SECOND)) is None


@pytest.mark.parametrize(
    "content",
    [
        "", "{}", "[" * 2000, '{"boot": 1}',
        json.dumps(asdict(replace(BEGUN, boot="another"))),
        json.dumps({**asdict(BEGUN), "height_m": "NaN"}),
        json.dumps({**asdict(BEGUN), "sigma_m": 0.0}),
        json.dumps({**asdict(BEGUN), "local_ned": [1.0]}),
        json.dumps({**asdict(BEGUN), "time_ns": -(10**400)}),
        json.dumps({**asdict(BEGUN), "latitude_deg": 1e300}),
        json.dumps({**asdict(BEGUN), "origin": [1.0]}),
        json.dumps({**asdict(BEGUN), "autopilot_ns": "x"}),
        json.dumps({**asdict(BEGUN), "sigma_m": 1e300}),
    ],
)  # fmt: skip
def test_a_file_of_another_boot_or_without_sense_is_none(tmp_path: Path, content: str) -> None:
    path = kept(tmp_path)
    path.write_text(content)
    assert read_last_fix(path, boot_id()) is None


def test_a_file_that_others_may_write_or_a_pipe_is_none(tmp_path: Path) -> None:
    path = kept(tmp_path)
    assert read_last_fix(path, boot_id()) == BEGUN
    path.chmod(0o666)
    assert read_last_fix(path, boot_id()) is None
    os.remove(path)
    assert read_last_fix(path, boot_id()) is None
    os.mkfifo(path, 0o600)  # it is not waited for
    assert read_last_fix(path, boot_id()) is None


def test_once_found_the_memory_is_its_own(tmp_path: Path) -> None:
    """And an end in order leaves nothing behind; a kill would."""
    path = kept(tmp_path)
    state = VehicleState(clock_offset_ns=40 * SECOND, origin=ORIGIN)
    kept_on = memory(path, (1.0, 2.0, 3.0), state)
    kept_on.start()
    kept_on.add_estimate(tracked(104 * SECOND), None)  # type: ignore[arg-type]
    assert kept_on.prior(105 * SECOND) is None
    assert sleep_until(lambda: read_last_fix(path, boot_id()) != BEGUN, 60.0)
    now = read_last_fix(path, boot_id())
    assert (now.time_ns, now.local_ned) == (104 * SECOND, (1.0, 2.0, 3.0))
    assert (now.autopilot_ns, now.origin) == (64 * SECOND, (47.0, 8.0, 453.0))
    assert FRAME.enu_from_geodetic(
        now.latitude_deg, now.longitude_deg, now.height_m
    ) == pytest.approx([5.0, 6.0, 80.0], abs=1e-3)
    kept_on.stop()
    assert not path.exists()


def test_what_cannot_be_kept_or_removed_ends_no_flight(tmp_path, caplog):
    path = tmp_path / "last-fix.json"
    path.mkdir()  # neither replaced by a file, nor removed as one
    kept_on = memory(path)
    kept_on.start()
    kept_on.add_estimate(tracked(104 * SECOND), None)  # type: ignore[arg-type]
    assert sleep_until(lambda: "is not kept" in caplog.text, 60.0)
    kept_on.stop()
    assert "is not removed" in caplog.text
