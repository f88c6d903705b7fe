"""The in-flight watch over recorded flights: what it called wrong, how soon, and falsely.

    python -m benchmarks.calibration.watched FLIGHT... [--json out.json]

A FLIGHT is a folder of `python -m sitl loop` or `demo` (VEHICLE-CASE-SEED with companion*/ and
flight.tlog), or one of `python -m benchmarks.calibration` (SEED beside its draws.jsonl) or of
`benchmarks.calibration.zoomed`. Its fixes and the autopilot's messages go through
`companion.calibration_watch` again in the order of their times. A finding is false where the
flight's own error is below half its limit, and neither right nor wrong between there and the limit;
it is told once it has stood for as long as in flight.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.draws import drawn
from benchmarks.common.arguments import Parser, output
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from companion.calibrate import unknowns as u
from companion.calibration_watch.config import CalibrationLimits
from companion.calibration_watch.observation import CalibrationEstimate, CalibrationObservation
from companion.calibration_watch.watch import CalibrationFigures, CalibrationWatch
from companion.errors import CompanionError, RecordError
from companion.geometry import ned_from_world
from companion.integrity_monitor.inertial import InertialTrack
from companion.offline.autopilot import RecordedAutopilot
from companion.offline.replay import FlightRecord, RecordedEstimate, load_record
from localizer.errors import MapCacheError
from localizer.geometry.pose import matrix_from_quaternion, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface
from mavlink_bridge.alerts.catalogue import CATALOGUE
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.link.tlog import read_tlog
from mavlink_bridge.messages import VehicleState
from sitl.demo.scenario import ScenarioError
from sitl.suite.loop.case import load_loop_cases

NAMES = ("focal length", "boresight", "time")
WITHIN_S = 60.0
_LIMITS = CalibrationLimits()
_HALF = CalibrationLimits(
    focal_share=0.5 * _LIMITS.focal_share, boresight_deg=0.5 * _LIMITS.boresight_deg,
    time_s=0.5 * _LIMITS.time_s,
)  # fmt: skip
_OURS = ("VISION_POSITION_ESTIMATE", "ODOMETRY", "GPS_INPUT")
_INTERVAL_NS, _STEP_NS = 250_000_000, 250_000_000
_LATER_NS = 1_000_000_000
COLUMNS = (
    "error", "beyond its limit", "found within 60 s", "after s", "within half of the limit, told",
    "others", "falsely",
)  # fmt: skip


@dataclass(frozen=True)
class Errors:
    """What the deployment has wrong: share that the focal length is long, deg, s; from_s: since
    when, on the flight's clock.
    """

    focal: float = 0.0
    boresight_deg: float = 0.0
    late_s: float = 0.0
    from_s: float = 0.0

    def beyond(self, limits: CalibrationLimits) -> tuple[bool, bool, bool]:
        """Which exceed their limit, as `NAMES`."""
        return (
            abs(self.focal) > limits.focal_share,
            abs(self.boresight_deg) > limits.boresight_deg,
            abs(self.late_s) > limits.time_s,
        )


@dataclass(frozen=True)
class Watched:
    """One flight. told_s: seconds from the first fix (or from when the error began) to each
    finding, as `NAMES`; None: never. figures: the last ones, value and sigma of each.
    """

    name: str
    seconds: float
    fixes: int
    errors: Errors
    beyond: tuple[bool, ...]
    told_s: tuple[float | None, ...]
    figures: tuple[tuple[float, float], ...]


class _Vehicle:
    """The recorded autopilot as the bridge would have shown it. ours_ns: when fixes began to go to
    the EKF, which is no evidence from then on.
    """

    def __init__(self, recorded: RecordedAutopilot, ours_ns: int | None) -> None:
        self.recorded, self._ours_ns = recorded, ours_ns
        self.now_ns = 0
        self.gimbal_at, self.attitude_at = recorded.gimbal_at, recorded.attitude_at
        self.inertial_since = recorded.inertial_since

    def state(self) -> VehicleState:
        """Of now."""
        return self.recorded.state()

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        """While the EKF follows a healthy GNSS."""
        ours = self._ours_ns is not None and self.now_ns >= self._ours_ns
        if ours or not gnss_healthy(self.state(), self.now_ns):
            return None
        return self.recorded.global_at(time_ns)


def watch_flight(folder: Path) -> Watched:
    """Through the watch again. `RecordError` where the record or its map is not there."""
    errors, limits = _errors(folder), _LIMITS
    records = sorted(folder.glob("companion*/estimates.csv")) or [folder / "record/estimates.csv"]
    record = load_record(records[0].parent, 0.0)
    found = list(_figures(record, folder / "flight.tlog", limits))
    if not found:
        raise RecordError(f"{folder}: no fix that could be watched")
    begin_s = max(found[0][0], errors.from_s + record.start_ns * 1e-9 if errors.from_s else 0.0)
    told: list[float | None] = []
    bounds = (limits.focal_share, limits.boresight_deg, limits.time_s)
    for which, bound in enumerate(bounds):
        times = [t for t, f in found if _of(f)[which].exceeds(bound)]
        told.append(_latched(times, [t for t, _ in found], begin_s))
    last = _of(found[-1][1])
    return Watched(
        folder.name, found[-1][0] - found[0][0], len(found), errors, errors.beyond(limits),
        tuple(told), tuple((f.value, f.sigma) for f in last),
    )  # fmt: skip


def _of(
    figures: CalibrationFigures,
) -> tuple[CalibrationEstimate, CalibrationEstimate, CalibrationEstimate]:
    return figures.focal, figures.boresight_deg, figures.late_s


def _latched(bad: Sequence[float], all_s: Sequence[float], begin_s: float) -> float | None:
    """Seconds until a finding has stood as long as the monitor waits before it tells."""
    told, since = set(bad), None
    for t in all_s:
        if t not in told:
            since = None
            continue
        since = t if since is None else since
        if t - since >= CATALOGUE[AlertId.FOCAL_LENGTH].raise_s:
            return t - begin_s
    return None


def _figures(
    record: FlightRecord, tlog: Path, limits: CalibrationLimits
) -> Iterator[tuple[float, CalibrationFigures]]:
    """Seconds on the record's clock, and what was known then."""
    cache = TileCache.open(record.config.map)
    surface = MapSurface(cache)
    recorded = RecordedAutopilot(
        record.config.bridge, tlog, record.start_ns, record.utc_minus_monotonic_ns
    )
    vehicle = _Vehicle(recorded, _ours_ns(record, tlog))
    watch, track = CalibrationWatch(limits), InertialTrack()
    sigmas = _sigmas(record.folder)
    good = [e for e in record.estimates if e.accepted and e.is_tracking]
    waiting = iter(sorted(good, key=lambda e: e.known_ns))
    estimate = next(waiting, None)
    if estimate is None:
        return
    now_ns, next_ns = estimate.known_ns - 10 * _LATER_NS, 0
    end_ns = max(e.known_ns for e in good) + _LATER_NS
    seen = False
    while now_ns < end_ns:
        now_ns += _STEP_NS
        vehicle.now_ns = now_ns
        recorded.advance(now_ns)
        while estimate is not None and estimate.known_ns <= now_ns:
            if estimate.exposure_time_ns >= next_ns:
                sighting = _sighting(estimate, record, cache, surface, vehicle, sigmas)
                if sighting is not None:
                    watch.add(sighting)
                    next_ns, seen = estimate.exposure_time_ns + _INTERVAL_NS, True
            estimate = next(waiting, None)
        for sample in vehicle.inertial_since(track.newest_ns):
            track.add(sample, vehicle.attitude_at)
        watch.step(now_ns, vehicle, track)
        if seen:
            yield now_ns * 1e-9, watch.figures()


def _sighting(
    estimate: RecordedEstimate, record: FlightRecord, cache: TileCache, surface: MapSurface,
    vehicle: _Vehicle, sigmas: dict[int, float],
) -> CalibrationObservation | None:  # fmt: skip
    pose = estimate.world_from_camera
    hit = float(surface.cast(pose.translation, pose.rotation[:, 2][None]).distances[0])
    if not np.isfinite(hit):
        return None
    attitude = vehicle.attitude_at(estimate.exposure_time_ns)
    at = pose.translation
    if attitude is not None and any(record.config.camera.lever_arm_m):
        to_ned = ned_from_world(cache.frame, cache.frame.position(at))
        body = to_ned.T @ matrix_from_quaternion(attitude.quaternion)
        at = at - body @ np.array(record.config.camera.lever_arm_m)
    where = cache.frame.position(at)
    return CalibrationObservation(
        estimate.exposure_time_ns, (where.latitude_deg, where.longitude_deg, where.height_m),
        sigmas.get(estimate.exposure_time_ns, 0.5),
        ned_from_world(cache.frame, where) @ pose.rotation, hit,
        record.config.camera.model.camera().horizontal_fov_deg,
    )  # fmt: skip


def _sigmas(folder: Path) -> dict[int, float]:
    """Horizontal sigma of each estimate, by its exposure."""
    with (folder / "estimates.csv").open(newline="", encoding="utf-8") as file:
        return {
            int(row["exposure_time_ns"]): max(
                float(row["sigma_east_m"]), float(row["sigma_north_m"])
            )
            for row in csv.DictReader(file)
            if row.get("sigma_north_m")
        }


def _ours_ns(record: FlightRecord, tlog: Path) -> int | None:
    """When the first fix went to the autopilot."""
    if record.config.bridge.mode == "shadow":
        return None
    for utc_ns, message in read_tlog(tlog):
        time_ns = utc_ns - record.utc_minus_monotonic_ns
        if message.get_type() in _OURS and time_ns >= record.start_ns:
            return int(time_ns)
    return None


def _errors(folder: Path) -> Errors:
    """What is wrong by the flight's own `errors.json`, by the draw's truth, or by the case that
    the folder's name says.
    """
    told = folder / "errors.json"
    if told.exists():
        return Errors(**json.loads(told.read_text()))
    rows = folder.parent / "draws.jsonl"
    if rows.exists():
        for line in rows.read_text().splitlines():
            row = json.loads(line)
            if str(row["seed"]) == folder.name:
                return _drawn(row)
        raise RecordError(f"{folder}: not in {rows}")
    _, _, rest = folder.name.partition("-")
    name, _, seed = rest.rpartition("-")
    try:
        case = load_loop_cases([name])[0] if seed.isdecimal() else None
    except ScenarioError:
        case = None
    if case is None:
        return Errors()
    late = [
        (e.at_s, e.picture.late_s) for e in case.timeline
        if e.picture is not None and e.picture.kind == "stamped_late"
    ]  # fmt: skip
    worst = float(np.abs(case.wrong.gimbal_deg).max())
    from_s, late_s = late[0] if late else (0.0, 0.0)
    return Errors(case.wrong.focal - 1.0, worst, late_s, from_s)


def _drawn(row: dict[str, Any]) -> Errors:
    """The boresight's worst axis at the angles that the gimbal flew."""
    draw, truth = drawn(row["seed"]), np.array(row["truth"])
    worst = 0.0
    for pitch_deg in (-90.0, -70.0, -50.0):
        level = so3_exp([0.0, np.radians(pitch_deg), 0.0])
        off = level @ truth[u.MOUNT] + np.array([0.0, 0.0, truth[u.HEADING]])
        worst = max(worst, float(np.degrees(np.abs(off).max())))
    return Errors(1.0 / (1.0 + draw.focal) - 1.0, worst, draw.late_s)


def summary(flights: Sequence[Watched]) -> dict[str, Any]:
    """Of each error: found within a minute, found at all, and called wrong falsely."""
    made: dict[str, Any] = {}
    for which, name in enumerate(NAMES):
        bad = [f for f in flights if f.beyond[which]]
        good = [f for f in flights if not f.beyond[which]]
        far = [f for f in good if not f.errors.beyond(_HALF)[which]]
        times = [f.told_s[which] for f in bad]
        made[name] = {
            "beyond": len(bad),
            "found_within_60_s": sum(t is not None and t <= WITHIN_S for t in times),
            "found": sum(t is not None for t in times),
            "seconds": sorted(t for t in times if t is not None),
            "near": len(good) - len(far),
            "near_told": sum(f.told_s[which] is not None for f in good if f not in far),
            "far": len(far),
            "false": [f.name for f in far if f.told_s[which] is not None],
        }
    right = [f for f in flights if f.errors == Errors()]
    return {
        "flights": len(flights), "nothing_wrong": len(right),
        "nothing_wrong_hours": sum(f.seconds for f in right) / 3600.0,
        "false_alarms_of_them": [f.name for f in right if any(t is not None for t in f.told_s)],
        "errors": made,
    }  # fmt: skip


def rows_of(made: dict[str, Any]) -> list[tuple[str, ...]]:
    """Cells under `COLUMNS`."""
    rows: list[tuple[str, ...]] = [
        (
            name, str(g["beyond"]), str(g["found_within_60_s"]),
            ", ".join(f"{t:.0f}" for t in g["seconds"]) or "-",
            f"{g['near_told']} of {g['near']}", str(g["far"]), str(len(g["false"])),
        )
        for name, g in made["errors"].items()
    ]  # fmt: skip
    minutes = f"nothing wrong ({60 * made['nothing_wrong_hours']:.0f} minutes)"
    falsely = str(len(made["false_alarms_of_them"]))
    rows.append((minutes, "-", "-", "-", "-", str(made["nothing_wrong"]), falsely))
    return rows


def table(made: dict[str, Any]) -> str:
    """The summary in lines."""
    lines = [
        f"{made['flights']} flights; {made['nothing_wrong']} with nothing wrong "
        f"({60 * made['nothing_wrong_hours']:.0f} minutes), "
        f"{len(made['false_alarms_of_them'])} of them called wrong"
    ]
    for name, g in made["errors"].items():
        seconds = ", ".join(f"{t:.0f}" for t in g["seconds"]) or "-"
        lines.append(
            f"{name}: {g['found_within_60_s']} of {g['beyond']} beyond the limit found within "
            f"60 s ({seconds} s); of {g['near']} within half of it {g['near_told']} told; "
            f"{len(g['false'])} of {g['far']} others called wrong"
        )
    return "\n".join(lines)


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("flights", type=Path, nargs="+", help="folders")
    p.add_argument("--json", type=output, help="the report")
    args = p.parse_args()
    flights = []
    for folder in args.flights:
        try:
            flights.append(watch_flight(folder))
        except (BridgeError, CompanionError, MapCacheError, OSError) as error:
            print(f"left out: {error}".splitlines()[0])
            continue
        print(flights[-1].name, flights[-1].told_s, flights[-1].figures, flush=True)
    made = summary(flights)
    print(table(made))
    if args.json:
        write_figures(
            args.json, COLUMNS, rows_of(made), made | {"each": [asdict(f) for f in flights]}
        )


if __name__ == "__main__":
    with named_errors():
        main()
