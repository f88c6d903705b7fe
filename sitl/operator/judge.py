"""What came of an operator's clicks: every report held against what he pointed at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.offline.tables import Columns, read_columns
from companion.targets.detections import clicked_name
from localizer.geometry.pose import Array
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import values_of
from sitl.operator.operator import SentWish
from sitl.operator.station import GeoReport, ReceivedMessages
from sitl.operator.truth import GroundTruth, Pointed, all_pointed

_CHI2_95, _CHI2_999 = 7.815, 13.816  # of three and of two degrees of freedom
_OWN_PX = 3.0  # beside what its own bound allows, a report is under its pixel
_APART_M = 5.0
_LOOKED_NS = 5_000_000_000
_LAG_NS = 1_500_000_000  # what was told before a stop, or of the last target, may still come
_WITHIN_M = (1.0, 3.0)  # p95 and largest error of a standing target that was looked at


@dataclass(frozen=True)
class TargetLine:
    """One target's reports. errors: 3-D, metres; late_*: from five seconds of looking on; inside:
    share whose error is within the stated 95 % bound. off_px: the largest between its place in the
    picture that was pointed into and the pixel; not_own: reports that are not under that pixel;
    elsewhere: at another target's place; velocities: told of what stands; after_end: after its end.
    """

    number: int
    kind: str
    reports: int
    late: int
    p50_m: float
    p95_m: float
    max_m: float
    late_p95_m: float
    late_max_m: float
    inside: float
    off_px: float
    not_own: int
    elsewhere: int
    velocities: int
    after_end: int
    on_mover: bool
    errors_m: tuple[float, ...] = ()
    late_errors_m: tuple[float, ...] = ()
    insides: int = 0


@dataclass(frozen=True)
class ClickVerdict:
    """A flight's clicks. unanswered: commands without an answer, or refused; untold: accepted and
    never reported; without a word: of them. link: CAMERA_TRACKING_GEO_STATUS that came; foreign: of
    them at no living target's place; link_velocities: with a velocity of what stands.
    """

    clicks: int
    stops: int
    unanswered: int
    unreported: int
    silent: int
    link: int
    foreign: int
    link_velocities: int
    images: int
    failure: str
    lines: tuple[TargetLine, ...]
    texts: tuple[str, ...] = ()
    late_s: tuple[float, ...] = ()
    problems: tuple[str, ...] = field(default=())


def judge(
    witness: GroundTruth,
    asked: Sequence[SentWish],
    heard: ReceivedMessages,
    targets: Path,
    failure: str = "",
) -> ClickVerdict:
    """Hold the record's targets (``targets.csv``) and what came over the link against the truth."""
    pointed = all_pointed(witness, asked)
    table = read_columns(targets, ("target_id", "visibility"))
    names = np.asarray(table.get("target_id", np.empty(0, str)))
    ends = {n: a.answered_ns for a in asked for n in a.ended}
    lines, unreported = [], []
    for number, point in pointed.items():
        rows = np.flatnonzero(names == clicked_name(number))
        if len(rows) and point.place is not None:
            others = [p.place for n, p in pointed.items() if n != number and p.place is not None]
            lines.append(_line(witness, point, others, {k: v[rows] for k, v in table.items()},
                               ends.get(number, 1 << 62)))  # fmt: skip
        elif not len(rows):
            unreported.append(number)
    texts = tuple(text for _, text in heard.texts)
    silent = [n for n in unreported if not any(_is_about(text, n) for text in texts)]
    clicks = [a for a in asked if a.wish.kind != "stop"]
    foreign, velocities = _link(witness, asked, pointed, heard.geo)
    verdict = ClickVerdict(
        len(clicks), len(asked) - len(clicks), sum(a.result != 0 for a in asked), len(unreported),
        len(silent), len(heard.geo), foreign, velocities, len(heard.image), failure, tuple(lines),
        texts, tuple(a.late_s for a in clicks),
    )  # fmt: skip
    return ClickVerdict(**{**verdict.__dict__, "problems": _problems(verdict)})


def _is_about(text: str, number: int) -> bool:
    """Texts of the operator's link: the catalogue's alerts of this target."""
    read = values_of(text)
    return read is not None and (
        read[0] is AlertId.NO_TARGET or read[1].get("number") == str(number)
    )


def _line(
    witness: GroundTruth, point: Pointed, others: Sequence[Array], table: Columns, ends_ns: int
) -> TargetLine:
    place = point.place
    assert place is not None
    told = np.column_stack([table[f"{a}_m"] for a in ("east", "north", "up")])
    P = _covariances(table)
    off = told - place
    errors = np.linalg.norm(off, axis=1)
    inside = np.einsum("ni,nij,nj->n", off, np.linalg.inv(P), off) <= _CHI2_95
    late = table["exposure_time_ns"] - point.asked.frame_ns >= _LOOKED_NS
    pixels = [_pixel_error(witness, point, x, C) for x, C in zip(told, P, strict=True)]
    away = np.array([np.linalg.norm(told - o, axis=1) for o in others]).reshape(-1, len(told))
    nearest = away.min(axis=0) if len(away) else np.full(len(told), np.inf)
    after = table["exposure_time_ns"] > ends_ns + _LAG_NS // 10
    return TargetLine(
        point.asked.number, point.asked.wish.kind, len(told), int(late.sum()),
        float(np.quantile(errors, 0.5)), float(np.quantile(errors, 0.95)), float(errors.max()),
        float(np.quantile(errors[late], 0.95)) if late.any() else float("nan"),
        float(errors[late].max()) if late.any() else float("nan"),
        float(inside.mean()), max(px for px, _ in pixels), sum(not own for _, own in pixels),
        int(((errors > _APART_M) & (nearest < errors)).sum()),
        int(np.isfinite(table["velocity_east"]).sum()), int(after.sum()), point.on_mover,
        tuple(float(e) for e in errors), tuple(float(e) for e in errors[late]), int(inside.sum()),
    )  # fmt: skip


def _covariances(table: Columns) -> Array:
    """(N, 3, 3) m²."""
    ee, en, eu, nn, nu, uu = (table[f"cov_{k}"] for k in ("ee", "en", "eu", "nn", "nu", "uu"))
    stacked: Array = np.array([[ee, en, eu], [en, nn, nu], [eu, nu, uu]]).transpose(2, 0, 1)
    return stacked


def _pixel_error(
    witness: GroundTruth, point: Pointed, place: Array, P: Array
) -> tuple[float, bool]:
    """How far a told place is from the pixel in the picture that was pointed into, and whether its
    stated error covers that.
    """
    at = point.pose.inverse.apply(place)
    pixel, inside = witness.camera.project(at)
    if not bool(inside):
        return float("inf"), False
    off = np.asarray(pixel) - point.pixel
    distance = float(np.linalg.norm(off))
    # First order, about the optical axis: what across the ray is one metre.
    scale = witness.camera.fx / at[2]
    across = point.pose.rotation[:, :2].T @ P @ point.pose.rotation[:, :2] * scale**2
    spread = float(np.sqrt(_CHI2_999 * np.linalg.eigvalsh(across)[-1]))
    return distance, distance <= _OWN_PX + spread


def _link(
    witness: GroundTruth,
    asked: Sequence[SentWish],
    pointed: Mapping[int, Pointed],
    reports: Sequence[GeoReport],
) -> tuple[int, int]:
    """(reports at no living target's place, with a velocity of what stands)."""
    foreign = velocities = 0
    for report in reports:
        alive = _alive(asked, report.time_ns)
        points = [pointed[n] for n in alive if n in pointed and pointed[n].place is not None]
        told = witness.place_of(report.latitude_deg, report.longitude_deg, report.altitude_m)
        bound = 3.0 * float(np.hypot(report.h_accuracy_m, report.v_accuracy_m)) + 1.0
        offs = [(float(np.linalg.norm(told - p.place)), p) for p in points if p.place is not None]
        nearest = min(offs, default=None, key=lambda o: o[0])
        if nearest is None or (nearest[0] > max(bound, _APART_M) and not nearest[1].on_mover):
            foreign += 1
        elif report.velocity is not None and not nearest[1].on_mover:
            velocities += 1
    return foreign, velocities


def _alive(asked: Sequence[SentWish], time_ns: int) -> tuple[int, ...]:
    """Numbers that may be told at a time: given, and not ended longer than a moment ago."""
    given: list[int] = []
    for a in asked:
        if a.wish.kind != "stop" and a.sent_ns <= time_ns:
            given.append(a.number)
        if a.answered_ns + _LAG_NS <= time_ns:
            given = [n for n in given if n not in a.ended]
    return tuple(given)


def _problems(verdict: ClickVerdict) -> tuple[str, ...]:
    """What does not hold, in words."""
    standing = [line for line in verdict.lines if not line.on_mover]
    counts = {
        "the operator's program failed: " + verdict.failure: bool(verdict.failure),
        "commands without an answer or refused": verdict.unanswered,
        "clicks without a report and without a word": verdict.silent,
        "reports over the link at no living target's place": verdict.foreign,
        "velocities over the link of what stands": verdict.link_velocities,
        "nothing came over the link": verdict.clicks > 0 and not verdict.link,
        "reports not under their own pixel": sum(line.not_own for line in standing),
        "reports at another target's place": sum(line.elsewhere for line in standing),
        "velocities of what stands": sum(line.velocities for line in standing),
        "reports after the target's end": sum(line.after_end for line in verdict.lines),
    }
    found = [f"{what}: {int(n)}" if n is not True else what for what, n in counts.items() if n]
    for line in standing:
        if line.late and (line.late_p95_m > _WITHIN_M[0] or line.late_max_m > _WITHIN_M[1]):
            found.append(
                f"target {line.number} after 5 s: p95 {line.late_p95_m:.2f} m, "
                f"at most {line.late_max_m:.2f} m"
            )
    return tuple(found)
