"""Writes a plan as one self-contained HTML page, and as JSON data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.planning.plan import MissionForecast
from companion.planning.verdicts import LegVerdict, VisionGap
from companion.reporting.content import Report, ReportTable
from companion.reporting.layout import write_report
from companion.versions import made_by
from localizer.types import Image

LEG_HEADINGS = (
    "leg", "m", "works", "sigma m", "lost or wrong", "map", "similar", "condition", "reason"
)  # fmt: skip
STRETCH_HEADINGS = ("from m", "to m", "length m", "seconds", "drift m", "odometry")
PROPOSAL_HEADINGS = ("leg", "fly", "lost or wrong", "sigma m", "works then")


def verdict_words(plan: MissionForecast) -> str:
    """The result of a plan in a sentence, for the user."""
    bad = [v for v in plan.verdicts if not v.holds]
    limit = plan.question.limits.sigma_m
    circles = sum(v.leg.is_circle for v in plan.verdicts)
    count = f"{len(plan.verdicts) - circles} legs"
    if circles:
        count += f" and {circles} {'circle' if circles == 1 else 'circles'}"
    if bad:
        lost = sum(s.length_m for s in plan.stretches)
        said = (
            f"Vision fails on {len(bad)} of {count}: {lost:.0f} of {plan.length_m:.0f} m need "
            f"odometry or another route"
        )
    else:
        which = f"the {count} that could be judged" if plan.not_judged else f"all {count}"
        said = (
            f"Vision should work on {which} ({plan.length_m / 1000:.1f} km), sigma below "
            f"{limit:g} m"
        )
    return said + (f". Not judged: {'; '.join(plan.not_judged)}." if plan.not_judged else ".")


def leg_row(verdict: LegVerdict) -> tuple[str, ...]:
    """Table cells of a leg, with the reason at its worst sample."""
    worst = verdict.worst
    forecast = worst.forecast
    return (
        verdict.leg.name + (f" (x {verdict.times})" if verdict.times > 1 else ""),
        f"{verdict.leg.length_m:.0f}",
        f"{100 * verdict.share:.0f} %",
        "none" if math.isnan(verdict.sigma_m) else f"{verdict.sigma_m:.2f}",
        f"{100 * forecast.risk:.0f} %",
        f"{100 * forecast.figures.map_share:.0f} %",
        f"{100 * forecast.rival.share:.0f} %",
        forecast.condition,
        "" if worst.holds else worst.reason.value,
    )


def stretch_row(stretch: VisionGap) -> tuple[str, ...]:
    """Table cells of a stretch without vision."""
    return (
        f"{stretch.begin_m:.0f}",
        f"{stretch.end_m:.0f}",
        f"{stretch.length_m:.0f}",
        f"{stretch.seconds:.0f}",
        f"{stretch.drift_m:.1f}",
        "continues" if stretch.can_bridge else "ends before",
    )


def proposal_rows(plan: MissionForecast) -> list[tuple[str, ...]]:
    """Table rows of the alternatives."""
    return [
        (
            i.leg,
            i.change.words,
            f"{100 * i.risk:.0f} %",
            f"{i.sigma_m:.2f}",
            "yes" if i.holds else "no, but better",
        )
        for i in plan.proposals
    ]


def as_data(plan: MissionForecast) -> dict[str, Any]:
    """JSON data of a plan: request, legs, samples and stretches."""
    q = plan.question
    return {
        "mission": str(q.mission_file),
        "conditions": list(q.conditions),
        "sigma_limit_m": q.limits.sigma_m,
        "risk_limit": q.limits.risk,
        "holds": plan.holds,
        "not_judged": list(plan.not_judged),
        "length_m": plan.length_m,
        "speed_m_s": plan.speed_m_s,
        "legs": [
            {
                "name": v.leg.name,
                "length_m": v.leg.length_m,
                "times": v.times,
                "holds": v.holds,
                "samples": [
                    {
                        "way_m": j.sample.way_m,
                        "position_enu_m": [float(x) for x in j.sample.position],
                        "condition": j.forecast.condition,
                        "risk": j.forecast.risk,
                        "sigma_m": j.forecast.sigma_m,
                        "map_share": j.forecast.figures.map_share,
                        "texture": j.forecast.texture,
                        "likest_place": j.forecast.rival.share,
                        "reason": j.reason.value,
                    }
                    for j in v.samples
                ],
            }
            for v in plan.verdicts
        ],
        "stretches": [
            {"begin_m": s.begin_m, "end_m": s.end_m, "seconds": s.seconds, "drift_m": s.drift_m}
            for s in plan.stretches
        ],
        "instead": [
            {"leg": i.leg, "fly": i.change.words, "risk": i.risk, "holds": i.holds}
            for i in plan.proposals
        ],
        "notes": list(plan.notes),
    }


def write_page(plan: MissionForecast, pictures: Sequence[tuple[str, Image]], path: Path) -> None:
    """Write the page; `ReportError` if it cannot be written."""
    q = plan.question
    bad = frozenset(k for k, v in enumerate(plan.verdicts) if not v.holds)
    tables = (
        ("Legs", ReportTable(LEG_HEADINGS, tuple(map(leg_row, plan.verdicts)), bad)),
        ("Without vision", ReportTable(STRETCH_HEADINGS, tuple(map(stretch_row, plan.stretches)))),
        ("Alternatives", ReportTable(PROPOSAL_HEADINGS, tuple(proposal_rows(plan)))),
    )
    report = Report(
        f"Forecast of {q.mission_file.name}",
        f"Under {', '.join(q.conditions)}; sigma to {q.limits.sigma_m:g} m, at most "
        f"{100 * q.limits.risk:.0f} % of the frames lost or more than 1 m wrong.",
        verdict=verdict_words(plan),
        tables=tuple(table for table in tables if table[1].rows),
        pictures=tuple(pictures),
        versions=made_by(),
        notes=plan.notes,
    )
    write_report(report, path)
