"""The table of the window's benchmark."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from localizer.geometry.pose import Array

Errors = dict[tuple[str, str, int], list[tuple[float, float]]]  # metres, degrees of every frame

COLUMNS = (
    "set", "places", "motion", "pose of", "frames", "within 1 m, 1°", "change", "within 3 m, 3°",
    "median m",
)  # fmt: skip
_FROM = 4  # the first frame that counts: before, no window has anything to add up
_DRAWS = 2000


def rows(name: str, places: Sequence[Errors]) -> list[tuple[str, ...]]:
    """One row for single frames and one for every window."""
    table: list[tuple[str, ...]] = []
    single = _shares(places, ("", "single", 1), 1.0)
    for key in places[0]:
        motion, kind, frames = key
        near, far = _shares(places, key, 1.0), _shares(places, key, 3.0)
        metres = np.concatenate([np.array(place[key])[_FROM:, 0] for place in places])
        change = "" if kind == "single" else _change(near - single)
        table.append(
            (name, str(len(places)), motion, kind, str(frames), f"{near.mean():.0f}", change,
             f"{far.mean():.0f}", f"{np.median(metres):.2f}")
        )  # fmt: skip
    return table


def _shares(places: Sequence[Errors], key: tuple[str, str, int], limit: float) -> Array:
    """Per cent of the frames (n,) of each place within `limit` metres and degrees."""
    found = [(np.array(place[key])[_FROM:] < limit).all(axis=1).mean() for place in places]
    return 100 * np.array(found)


def _change(differences: Array) -> str:
    """The mean with its 95 % interval, places drawn anew."""
    rng = np.random.default_rng(0)
    draws = rng.choice(differences, (_DRAWS, len(differences))).mean(axis=1)
    low, high = np.quantile(draws, (0.025, 0.975))
    return f"{differences.mean():+.0f} ({low:+.0f}, {high:+.0f})"
