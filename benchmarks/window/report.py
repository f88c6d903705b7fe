"""The table of the window's benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array


@dataclass(frozen=True)
class Error:
    """Of one pose: metres (3,) in world axes, and degrees."""

    offset: Array
    degrees: float

    def within(self, limit: float) -> bool:
        """`limit` metres and degrees."""
        return bool(np.linalg.norm(self.offset) < limit and self.degrees < limit)


Errors = dict[tuple[str, str, int], list[Error]]  # of every frame, by (motion, kind, frames)

COLUMNS = (
    "set", "begins", "places", "motion", "pose of", "frames", "within 1 m, 1°", "change",
    "within 3 m, 3°", "median, m", "shared, of the wrong",
)  # fmt: skip
_FROM = 4  # the first frame that counts: before, no window has anything to add up
_DRAWS = 2000


def rows(name: str, begins: str, places: Sequence[Errors]) -> list[tuple[str, ...]]:
    """One row for single frames and one for every window."""
    table: list[tuple[str, ...]] = []
    single = _shares(places, ("", "single", 1), 1.0)
    for key in places[0]:
        motion, kind, frames = key
        near, far = _shares(places, key, 1.0), _shares(places, key, 3.0)
        metres = [np.linalg.norm(e.offset) for place in places for e in place[key][_FROM:]]
        change = "" if kind == "single" else _change(near - single)
        table.append(
            (name, begins, str(len(places)), motion, kind, str(frames), f"{near.mean():.0f}",
             change, f"{far.mean():.0f}", f"{np.median(metres):.2f}", _shared(places, key))
        )  # fmt: skip
    return table


def _shares(places: Sequence[Errors], key: tuple[str, str, int], limit: float) -> Array:
    """Per cent of the frames (n,) of each place within `limit` metres and degrees."""
    found = [np.mean([e.within(limit) for e in place[key][_FROM:]]) for place in places]
    return 100 * np.array(found)


def _shared(places: Sequence[Errors], key: tuple[str, str, int]) -> str:
    """Per cent of the squared metres that the frames of a place have in common.

    Of places where less than half of the frames are within 1 m and 1 degree: what no window over
    their votes can take away.
    """
    common = whole = 0.0
    for place in places:
        frames = place[key][_FROM:]
        if np.mean([e.within(1.0) for e in frames]) < 0.5:
            offsets = np.stack([e.offset for e in frames])
            common += float((offsets.mean(axis=0) ** 2).sum())
            whole += float((offsets**2).sum(axis=1).mean())
    return f"{100 * common / whole:.0f} %" if whole else ""


def _change(differences: Array) -> str:
    """The mean with its 95 % interval, places drawn anew."""
    rng = np.random.default_rng(0)
    draws = rng.choice(differences, (_DRAWS, len(differences))).mean(axis=1)
    low, high = np.quantile(draws, (0.025, 0.975))
    return f"{differences.mean():+.0f} ({low:+.0f}, {high:+.0f})"
