"""Compares a forecast with a flight: where vision was forecast to work, and where it did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.offline.record import read_estimates, read_record
from companion.planning.verdicts import LegVerdict
from localizer.forecast.risk import RISK_LIMIT
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache

FLOWN_HEADINGS = ("leg", "should work", "worked", "forecast right", "positions flown")


@dataclass(frozen=True)
class FlownLeg:
    """One leg. forecast, held: (N,) for the samples that were flown, whether vision should work
    there and whether it did; places: number of the leg's samples.
    """

    name: str
    places: int
    forecast: np.ndarray
    held: np.ndarray

    @property
    def row(self) -> tuple[str, ...]:
        """Table cells of the leg."""
        flown = f"{len(self.held)} of {self.places}"
        if not len(self.held):
            return self.name, "-", "-", "-", flown
        shares = (self.forecast.mean(), self.held.mean(), (self.forecast == self.held).mean())
        return (self.name, *(f"{100 * share:.0f} %" for share in shares), flown)


def flown_legs(
    verdicts: Sequence[LegVerdict], places: Array, accepted: np.ndarray
) -> tuple[FlownLeg, ...]:
    """Compare each leg's samples with the frames of the flight within half a step horizontally; a
    sample without such a frame was not flown.
    places: (F, 3) positions of all frames; accepted: (F,), whether each was localized.
    """
    legs = []
    for verdict in verdicts:
        forecast, held = [], []
        for judged in verdict.samples:
            away = np.linalg.norm(places[:, :2] - judged.sample.position[:2], axis=1)
            near = away <= max(verdict.leg.step_m / 2, 1.0)
            if near.any():
                forecast.append(judged.holds)
                held.append(bool(accepted[near].mean() >= 1.0 - RISK_LIMIT))
        told = (np.array(forecast, bool), np.array(held, bool))
        legs.append(FlownLeg(verdict.leg.name, len(verdict.samples), *told))
    return tuple(legs)


def recorded_frames(record: Path, cache: TileCache) -> tuple[Array, np.ndarray]:
    """Positions (F, 3) of a record's frames, world metres, and whether each was localized.
    `RecordError` if the folder is no record, or of another map.
    """
    read_record(record).flown_map.require_frame(cache)
    estimates = read_estimates(record / "estimates.csv")
    places = np.array([e.world_from_camera.translation for e in estimates]).reshape(-1, 3)
    return places, np.array([e.accepted for e in estimates], bool)


def flown_words(legs: Sequence[FlownLeg]) -> str:
    """The comparison in a sentence, for the user."""
    forecast = np.concatenate([leg.forecast for leg in legs])
    held = np.concatenate([leg.held for leg in legs])
    if not len(held):
        return "The flight has no frame on this mission."
    return (
        f"Flown: {len(held)} places; the forecast is right at "
        f"{100 * (forecast == held).mean():.0f} %; {int((forecast & ~held).sum())} failed that "
        f"should hold, {int((~forecast & held).sum())} held that should fail."
    )
