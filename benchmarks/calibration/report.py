"""What ten draws say: errors against their targets and against their own sigmas."""

from __future__ import annotations

from typing import Any

import numpy as np

from companion.calibrate import unknowns as u

# What is asked: the largest error of each group, in its numbers' own units.
TARGETS = {
    "focal length": ((u.FOCAL,), 0.003, 100.0, "%"),
    "boresight": ((8, 9, 10), float(np.radians(0.2)), float(np.degrees(1.0)), "deg"),
    "time": ((u.LATE,), 0.010, 1000.0, "ms"),
    "map, horizontally": ((15, 16), 0.3, 1.0, "m"),
    "map against the flight's GNSS": ((15, 16), 0.3, 1.0, "m"),
    "map, height": ((17,), 0.3, 1.0, "m"),
}
_INSIDE = 1.96
COLUMNS = ("number", "wanted", "draws within", "rms", "worst", "stated sigma", "inside 95 %")


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Groups with their errors; all numbers' share inside 95 %; the flights after it."""
    found, truth, sigma = (np.array([r[k] for r in rows]) for k in ("found", "truth", "sigma"))
    lsq = np.array([r["lsq_sigma"] for r in rows])
    off = np.array([r["ekf_off_m"] for r in rows])
    groups = {}
    for name, (which, target, scale, unit) in TARGETS.items():
        columns = list(which)
        error = found[:, columns] - truth[:, columns]
        bound = sigma[:, columns]
        if "GNSS" in name:  # what one flight can know: the receiver was off by so much itself
            error, bound = error + off[:, :2], lsq[:, columns]
        within = np.abs(error).max(axis=1) <= target
        groups[name] = {
            "target": target * scale, "unit": unit, "draws_within": int(within.sum()),
            "draws": len(rows), "rms": float(np.sqrt((error**2).mean())) * scale,
            "worst": float(np.abs(error).max()) * scale,
            "inside_95": float((np.abs(error) <= _INSIDE * bound).mean()),
            "sigma_median": float(np.median(bound)) * scale,
        }  # fmt: skip
    z = (found - truth) / sigma
    after = [r["again"] for r in rows if "again" in r]
    flights = {name: [a[name]["median"] for a in after] for name in ("old", "found", "true")}
    return {
        "draws": len(rows), "groups": groups,
        "inside_95_by_number": {
            n.name: float((np.abs(z[:, k]) <= _INSIDE).mean())
            for k, n in enumerate(u.UNKNOWNS[: u.CLIMB])
        },
        "inside_95_of_all": float((np.abs(z[:, : u.CLIMB]) <= _INSIDE).mean()),
        "flights_after_median_m": flights,
        "found_over_true": [f / t for f, t in zip(flights["found"], flights["true"], strict=True)],
        "within_10_percent": int(
            sum(f <= 1.1 * t for f, t in zip(flights["found"], flights["true"], strict=True))
        ),
    }  # fmt: skip


def rows_of(made: dict[str, Any]) -> list[tuple[str, ...]]:
    """Cells under `COLUMNS`."""
    rows: list[tuple[str, ...]] = [
        (
            f"{name}, {g['unit']}", f"{g['target']:.3g}", f"{g['draws_within']} of {g['draws']}",
            *(f"{g[key]:.2g}" for key in ("rms", "worst", "sigma_median")),
            f"{100 * g['inside_95']:.0f} %",
        )
        for name, g in made["groups"].items()
    ]  # fmt: skip
    found = np.array(made["found_over_true"])
    if len(found):
        share = f"{made['within_10_percent']} of {len(found)}"
        rows.append(
            (
                "median error of the flight after it, over the true deployment's", "1.1", share,
                f"{np.median(found):.2f} (median)", f"{found.max():.2f}", "-", "-",
            )
        )  # fmt: skip
    rows.append(("all numbers", "-", "-", "-", "-", "-", f"{100 * made['inside_95_of_all']:.0f} %"))
    return rows
