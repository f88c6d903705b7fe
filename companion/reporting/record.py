"""Report of a flight's record, without the truth; with the tracks of EKF and receiver from its
.tlog.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.offline.record import Columns, RecordTables, is_time_ns, mapping, poses, read_record
from companion.reporting import figures
from companion.reporting.content import (
    INNER,
    MIDDLE,
    OUTER,
    CriterionResult,
    Curve,
    MapTrack,
    Overlay,
    Plot,
    Report,
)
from companion.reporting.pictures import MapPictures, ShownFrame, map_pictures, silent
from companion.terminal.steps import Say
from localizer.geometry.geo import LocalFrame
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.tlog import read_tlog

_OVERLAYS = 8
KEPT_FRAMES = "the frames that the record kept (record.snapshot_interval_s), not of all"
_LATEST_MS = 250.0  # the oldest measurement that ArduPilot fuses
VISION = "#ff8c1a"
AUTOPILOT = "#1fd1ff"
GNSS = "#ffffff"


def record_report(folder: Path, say: Say = silent) -> Report:
    """Make the report of one record; writes nothing. say: receives the present step as text.
    `RecordError` for another folder.
    """
    tables = read_record(folder)
    camera, estimates = tables.camera, tables.estimates
    start_ns = tables.start_ns
    happened = figures.events(tables.events, start_ns)
    if not estimates:
        return Report(
            f"Flight {folder.name}", _how_it_ended(tables), "never localized",
            verdicts=_verdicts(tables), events=happened, notes=tables.notes,
            settings=tables.settings,
            versions=tables.versions,
        )  # fmt: skip
    time_s = figures.seconds(estimates["exposure_time_ns"], start_ns)
    with map_pictures(tables.map_path, say, tables.flown_map) as pictures:
        autopilot = read_autopilot(tables.tlog, tables.start_ns, tables.utc_ns, pictures)
        tracks = _tracks(estimates, autopilot)
        sheet = pictures.sheet(tracks, figures.target_marks(tables.targets))
        overlays: tuple[Overlay, ...] = ()
        if camera is not None:
            shown = worst_frames(tables, estimates["quality"] * 1.0, "quality", time_s)
            overlays = pictures.overlays(shown, camera)
        return Report(
            f"Flight {folder.name}",
            _how_it_ended(tables),
            figures.first_fault(estimates, time_s, happened),
            _verdicts(tables),
            sheet,
            _plots(tables, time_s, autopilot),
            None,
            (("state", figures.state_spans(time_s, estimates["state"])),),
            happened,
            overlays,
            figures.target_table(tables.targets),
            figures.stage_table(estimates),
            "time since the start, s",
            tables.settings,
            tables.versions,
            (*tables.notes, *pictures.notes),
            KEPT_FRAMES,
        )


def worst_frames(
    tables: RecordTables, goodness: np.ndarray, what: str, time_s: np.ndarray
) -> list[ShownFrame]:
    """At most eight recorded frames with the lowest `goodness` (one value per estimate; NaN is
    worst), worst first, those of a refused estimate last.
    Refused ones take at most half the places, if others are there. what: names `goodness` in the
    captions; time_s: of each estimate.
    """
    estimates = tables.estimates
    paths = sorted((tables.folder / "snapshots").glob("*.jpg"))
    paths = [p for p in paths if is_time_ns(p.stem)]
    stamps = np.asarray(estimates["exposure_time_ns"])
    order = np.argsort(stamps)
    found = figures.nearest(stamps[order], np.array([int(p.stem) for p in paths], dtype=np.int64))
    pairs = [(p, int(order[k])) for p, k in zip(paths, found, strict=True) if k >= 0]
    numbers = [estimates[k] for k in ("east_m", "north_m", "up_m", "qw", "qx", "qy", "qz")]
    placed_at = np.isfinite(np.column_stack(numbers)).all(axis=1)
    pairs = [p for p in pairs if placed_at[p[1]]]
    key = np.where(np.isfinite(goodness), goodness, -np.inf)
    pairs.sort(key=lambda pair: float(key[pair[1]]))
    accepted = np.asarray(estimates["accepted"]) > 0
    good = [p for p in pairs if accepted[p[1]]]
    refused = [p for p in pairs if not accepted[p[1]]]
    few = refused[: max(_OVERLAYS // 2, _OVERLAYS - len(good))]
    chosen = good[: _OVERLAYS - len(few)] + few
    placed = poses({k: v[[k for _, k in chosen]] for k, v in estimates.items()})
    return [
        ShownFrame(
            path,
            pose,
            f"t = {time_s[k]:.1f} s, {what} {_known(goodness[k])}, {estimates['state'][k]}, "
            + ("accepted" if accepted[k] else _refused(str(estimates["status"][k]))),
        )
        for (path, k), pose in zip(chosen, placed, strict=True)
    ]


def _known(figure: float) -> str:
    return f"{abs(figure):.2f}" if np.isfinite(figure) else "not known"


def _refused(status: str) -> str:
    """Why a frame was refused. status: of the registration, which may be OK all the same."""
    return "registered, not accepted" if status == "OK" else f"refused ({status})"


def uncertainty_plots(estimates: Columns, time_s: np.ndarray) -> tuple[Plot, ...]:
    """Plots of sigma, protection level and quality over time."""
    horizontal = np.hypot(estimates["sigma_east_m"], estimates["sigma_north_m"])
    accepted = np.asarray(estimates["accepted"]) > 0
    curves = [Curve("sigma horizontal", np.where(accepted, horizontal, np.nan))]
    if "hpl_m" in estimates:
        curves.append(Curve("protection level", np.asarray(estimates["hpl_m"])))
    quality = np.asarray(estimates["quality"])
    return (
        Plot("how sure it was, m", time_s, tuple(curves)),
        Plot("quality of the registration", time_s, (Curve("quality", quality),)),
    )


def _plots(
    tables: RecordTables, time_s: np.ndarray, autopilot: AutopilotTracks
) -> tuple[Plot, ...]:
    plots = []
    for name, track in (("GNSS", autopilot.gnss), ("the autopilot's EKF", autopilot.ekf)):
        if track is not None:
            residual = track.distance_to(tables.estimates)
            plots.append(Plot(f"vision against {name}, horizontal, m", time_s,
                              (Curve(f"from {name}", residual),)))  # fmt: skip
    return (
        *plots,
        *uncertainty_plots(tables.estimates, time_s),
        figures.stage_plot(tables.estimates, time_s, tables.delay_ms),
    )


def _tracks(estimates: Columns, autopilot: AutopilotTracks) -> list[MapTrack]:
    accepted = np.asarray(estimates["accepted"]) > 0
    vision = figures.track("vision (camera)", VISION, INNER, estimates)
    points = np.where(accepted[:, None], vision.points, np.nan)
    tracks = []
    if autopilot.gnss is not None:
        tracks.append(MapTrack("GNSS", GNSS, OUTER, autopilot.gnss.points))
    if autopilot.ekf is not None:
        tracks.append(MapTrack("autopilot's EKF", AUTOPILOT, MIDDLE, autopilot.ekf.points))
    return [*tracks, MapTrack(vision.name, vision.colour, vision.width, points)]


def _verdicts(tables: RecordTables) -> tuple[CriterionResult, ...]:
    """Criteria that can be judged without the truth."""
    health, estimates = tables.health, tables.estimates
    ended = health.get("level") == "ended"
    verdicts = [
        CriterionResult(
            "ended in order", str(health.get("text", "no health.json")), "an orderly end", ended,
            "the process died, was killed, or the computer lost power: the last seconds may lack",
            "the log of that time, power supply, `dmesg` for memory",
        )
    ]  # fmt: skip
    if estimates:
        accepted = np.asarray(estimates["accepted"]) > 0
        began = np.flatnonzero(np.asarray(estimates["state"]) == "tracking")
        share = 100.0 * float(accepted[began[0] :].mean()) if len(began) else 0.0
        verdicts.append(
            CriterionResult(
                "frames accepted once tracking", f"{share:.1f} %", ">= 95 %", share >= 95.0,
                "frames were refused, so there was no position for them",
                "quality over time and the worst of the kept frames",
            )
        )  # fmt: skip
        latency = np.asarray(estimates["latency_ms"])
        known = latency[np.isfinite(latency)]
        p95 = float(np.percentile(known, 95)) if len(known) else float("nan")
        limit = tables.delay_ms or _LATEST_MS
        verdicts.append(
            CriterionResult(
                "exposure to estimate p95", f"{p95:.0f} ms", f"<= {limit:.0f} ms", p95 <= limit,
                "fixes are older than delay_ms",
                "latency by stage; more processor, lower localizer.width, higher delay_ms",
            )
        )  # fmt: skip
    verdicts += _unreported_targets(health.get("targets"))
    shadow = _shadow(health.get("shadow"))
    if shadow:
        verdicts.append(
            CriterionResult(
                "shadow check at the end", str(shadow["text"]), "ready", bool(shadow["ready"]),
                "vision was not shown to agree with GNSS for long enough",
                "the reasons after the colon, and vision against GNSS",
            )
        )  # fmt: skip
    return tuple(verdicts)


def _shadow(told: Any) -> dict[str, Any]:
    """Shadow result of a health.json; version 0.1 wrote a line that begins with "go" or "no-go"."""
    if isinstance(told, str) and told:
        return {"ready": told.startswith("go"), "text": told}
    return mapping(told)


def _unreported_targets(counts: Any) -> list[CriterionResult]:
    """A criterion for clicks and detections that were not reported; [] if all were."""
    named = {k: v for k, v in mapping(counts).items() if isinstance(v, int) and v > 0}
    if not named:
        return []
    text = ", ".join(f"{number} {name}" for name, number in named.items())
    return [
        CriterionResult(
            "clicks and detections not reported", text, "none", False,
            "missed: no map under the pixel; doubted: position not reportable; refused: more "
            "than 32 at a time; unmatched: of a frame without a position; failed: an error",
            "events at that time; what the detector sends (docs/reference/formats.md)",
        )
    ]  # fmt: skip


def _how_it_ended(tables: RecordTables) -> str:
    if tables.health.get("level") == "ended":
        return f"{tables.folder}: {tables.health.get('text', '')}"
    return f"{tables.folder}: the end was not written"


_WITHIN_S = 0.5
_FIX_3D = 3


@dataclass(frozen=True)
class TimedTrack:
    """time_ns: (N,), reception time, CLOCK_MONOTONIC; points: (N, 2) east, north, m."""

    time_ns: np.ndarray
    points: np.ndarray

    def distance_to(self, estimates: Columns) -> np.ndarray:
        """Horizontal distance (E,) from each accepted estimate to the track, interpolated; NaN
        without a near sample.

        The distance contains the lever arm, and the delay of the messages times the speed.
        """
        times = np.asarray(estimates["exposure_time_ns"])
        begin = int(self.time_ns[0])
        known, wanted = (self.time_ns - begin) * 1e-9, (times - begin) * 1e-9
        at = [np.interp(wanted, known, self.points[:, i]) for i in (0, 1)]
        gap = np.abs(known[np.clip(np.searchsorted(known, wanted), 0, len(known) - 1)] - wanted)
        distance = np.hypot(estimates["east_m"] - at[0], estimates["north_m"] - at[1])
        usable = (gap < _WITHIN_S) & (np.asarray(estimates["accepted"]) > 0)
        return np.where(usable, distance, np.nan)


@dataclass(frozen=True)
class AutopilotTracks:
    """EKF and GNSS tracks; None if not recorded."""

    ekf: TimedTrack | None = None
    gnss: TimedTrack | None = None


def read_autopilot(
    tlog: Path | None, start_ns: int, utc_ns: int, pictures: MapPictures
) -> AutopilotTracks:
    """Read the tracks from the record's `bridge.tlog`, in the frame of the map that `pictures` has
    open. None without log, map or UTC; a log that cannot be read is noted in `pictures.notes`.
    start_ns, utc_ns: the record's begin on CLOCK_MONOTONIC and in UTC, 0 if unknown.
    """
    if tlog is None or pictures.cache is None or not utc_ns:
        return AutopilotTracks()
    try:
        return _autopilot_tracks(tlog, utc_ns - start_ns, start_ns, pictures.cache.frame)
    except (BridgeError, OSError) as error:
        pictures.notes.append(f"no track of the autopilot: {error}")
        return AutopilotTracks()


def _autopilot_tracks(
    path: Path, offset_ns: int, start_ns: int, frame: LocalFrame
) -> AutopilotTracks:
    rows: dict[str, list[tuple[int, float, float]]] = {"GLOBAL_POSITION_INT": [], "GPS_RAW_INT": []}
    for utc_ns, message in read_tlog(path):
        kind = message.get_type()
        if kind not in rows or utc_ns - offset_ns < start_ns:
            continue
        if kind == "GPS_RAW_INT" and message.fix_type < _FIX_3D:
            continue
        rows[kind].append((utc_ns - offset_ns, message.lat * 1e-7, message.lon * 1e-7))
    return AutopilotTracks(
        _track(rows["GLOBAL_POSITION_INT"], frame), _track(rows["GPS_RAW_INT"], frame)
    )


def _track(rows: list[tuple[int, float, float]], frame: LocalFrame) -> TimedTrack | None:
    height = frame.origin.height_m
    places = [
        (t, frame.enu_from_geodetic(lat, lon, height)[:2])
        for t, lat, lon in sorted(rows)
        if abs(lat) <= 90.0 and (lat, lon) != (0.0, 0.0)
    ]
    if not places:
        return None
    return TimedTrack(np.array([t for t, _ in places]), np.array([p for _, p in places]))
