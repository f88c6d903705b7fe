"""Tables and a plot of the judged images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np

if TYPE_CHECKING:
    from benchmarks.real.judged import JudgedImage
    from benchmarks.real.rivals import RivalImage
    from benchmarks.real.searched import SearchedImage

FOUND_M = 6.0  # an answer of the search within this is right


def attitude_text(sigma_deg: float | None) -> str:
    """As the tables name it."""
    return "none" if sigma_deg is None else f"{sigma_deg:g}°"


def judged_row(images: Sequence[JudgedImage]) -> dict[str, Any]:
    """The figures of one set at one attitude; of accepted images from `horizontal_m` on."""
    right = [i for i in images if i.right]
    used = [i for i in images if i.accepted]
    row: dict[str, Any] = {
        "set": images[0].set,
        "attitude": attitude_text(images[0].attitude_deg),
        "images": len(images),
        "right": len(right) / len(images),
        "accepted_of_right": sum(i.accepted for i in right) / max(len(right), 1),
        "wrong_accepted": sum(not i.right for i in used),
    }
    if not used:
        return row
    errors = np.array([i.horizontal_m for i in used])
    return row | {
        "horizontal_m": float(np.median(errors)),
        "horizontal_p95_m": float(np.quantile(errors, 0.95)),
        "nees": float(np.median([i.nees for i in used])),
        "nees_attitude": float(np.median([i.nees_attitude for i in used])),
        "inside": float(np.mean([i.inside for i in used])),
        "inside_horizontal": float(np.mean([i.inside_horizontal for i in used])),
        "level_m": float(np.median([i.level_m for i in used])),
        "beyond_level": sum(i.beyond_level for i in used),
    }


JUDGED = (
    "set", "attitude", "images", "right", "accepted of right", "wrong accepted",
    "horizontal m, p95", "NEES", "attitude NEES", "inside 95 %", "level m", "beyond level",
)  # fmt: skip


def judged_cells(r: dict[str, Any]) -> tuple[str, ...]:
    """A `judged_row` as `JUDGED` names it."""
    head = (
        r["set"], r["attitude"], str(r["images"]), f"{100 * r['right']:.0f} %",
        f"{100 * r['accepted_of_right']:.0f} %", str(r["wrong_accepted"]),
    )  # fmt: skip
    if "nees" not in r:
        return *head, *("-",) * (len(JUDGED) - len(head))
    return (
        *head, f"{r['horizontal_m']:.2f}, {r['horizontal_p95_m']:.2f}", f"{r['nees']:.2f}",
        f"{r['nees_attitude']:.2f}", f"{100 * r['inside']:.0f} %", f"{r['level_m']:.1f}",
        str(r["beyond_level"]),
    )  # fmt: skip


def displaced_row(images: Sequence[JudgedImage]) -> dict[str, Any]:
    """The figures of one set from wrong priors."""
    wrong = [i for i in images if not i.right]
    accepted = [i for i in wrong if i.accepted]
    return {
        "set": images[0].set,
        "registrations": len(images),
        "wrong": len(wrong),
        "wrong_accepted": len(accepted),
        "beyond_level": sum(i.beyond_level for i in accepted),
        "farthest_m": max((i.horizontal_m for i in accepted), default=None),
    }


DISPLACED = (
    "set, priors 45 to 110 m off", "registrations", "wrong", "wrong accepted", "farthest m",
    "beyond level",
)  # fmt: skip


def displaced_cells(r: dict[str, Any]) -> tuple[str, ...]:
    """A `displaced_row` as `DISPLACED` names it."""
    return (
        r["set"], str(r["registrations"]), str(r["wrong"]), str(r["wrong_accepted"]),
        _metres(r["farthest_m"]), str(r["beyond_level"]),
    )  # fmt: skip


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def searched_row(images: Sequence[SearchedImage]) -> dict[str, Any]:
    """The figures of one set's searches."""
    here, away = ([i for i in images if i.away is k] for k in (False, True))
    return {
        "set": images[0].set,
        "images": len(here),
        "found": sum(i.horizontal_m <= FOUND_M for i in here),
        "wrong": sum(i.found and i.horizontal_m > FOUND_M for i in here),
        "farthest_m": max((i.horizontal_m for i in here if i.found), default=None),
        "on_another_map": len(away),
        "found_on_another_map": sum(i.found for i in away),
        "seconds": float(np.median([i.seconds for i in here])),
    }


SEARCHED = (
    "set", "images", "found within 6 m", "found farther off", "farthest m",
    "found on another map", "median s",
)  # fmt: skip


def searched_cells(r: dict[str, Any]) -> tuple[str, ...]:
    """A `searched_row` as `SEARCHED` names it."""
    return (
        r["set"], str(r["images"]), str(r["found"]), str(r["wrong"]), _metres(r["farthest_m"]),
        f"{r['found_on_another_map']} of {r['on_another_map']}", f"{r['seconds']:.1f}",
    )  # fmt: skip


def rival_rows(rivals: Sequence[RivalImage], ours: Sequence[JudgedImage]) -> list[dict[str, Any]]:
    """Share of right images of every method on every set, ours of the same images."""
    rows = []
    for name in dict.fromkeys(r.set for r in rivals):
        mine = [i for i in ours if i.set == name]
        entries: list[tuple[str, list[float], list[bool], float | None]] = [
            ("ours", [i.centre_m for i in mine], [i.right for i in mine], None)
        ]
        for method in dict.fromkeys(r.method for r in rivals):
            of = [r for r in rivals if (r.set, r.method) == (name, method)]
            seconds = float(np.median([r.seconds for r in of]))
            entries.append((method, [r.centre_m for r in of], [r.right for r in of], seconds))
        for method, centre, right, took in entries:
            rows.append({
                "set": name, "method": method, "centre_m": float(np.median(centre)),
                "right": float(np.mean(right)), "seconds": took,
            })  # fmt: skip
    return rows


RIVALS = ("set", "method", "middle of the image m", "right", "s")


def rival_cells(r: dict[str, Any]) -> tuple[str, ...]:
    """One of `rival_rows` as `RIVALS` names it."""
    took = "-" if r["seconds"] is None else f"{r['seconds']:.2f}"
    return r["set"], r["method"], f"{r['centre_m']:.2f}", f"{100 * r['right']:.0f} %", took


def plot(images: Sequence[JudgedImage], path: Path) -> None:
    """Error over protection level of every accepted image, a colour for each set."""
    figure, axes = plt.subplots(figsize=(6.5, 5))
    for name in dict.fromkeys(i.set for i in images):
        used = [i for i in images if i.set == name and i.accepted]
        level, error = [i.level_m for i in used], [i.horizontal_m for i in used]
        axes.scatter(level, error, s=9, label=f"{name}, {len(used)}")
    ends = [0.1, 60.0]
    axes.plot(ends, ends, color="black", lw=0.8, ls="--")
    axes.set(xscale="log", yscale="log", xlabel="protection level, m", ylabel="position error, m")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)
