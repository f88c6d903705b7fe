"""Decides which registered candidate is the position, if any."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.registration.result import Registration
from localizer.relocalization.types import PlaceCandidate, PlaceQuery, Relocalization
from localizer.types import PosePrior

NEARLY = 0.8  # of the winner's correlation: a place that has to be looked at, too
_STANDS_OUT = 1.5  # times the quality of any other place. Equal houses: 1.0 to 1.19
CREDIBLE = 1.0  # log odds beyond those of a tracked frame, because many positions are compared
DECISIVE = 6.0  # log odds: the image alone leaves no doubt
SAME_PLACE_M = 5.0  # answers that are closer are one


@dataclass(frozen=True)
class VerifiedCandidate:
    """A candidate after registration. result: fused with attitude and height; prior: for the next
    pass; log_odds: of the position being right, by the image alone; credible: whether the other
    sensors agree, too.
    """

    candidate: PlaceCandidate
    rank: int
    result: Registration
    prior: PosePrior
    log_odds: float
    credible: bool

    @property
    def is_decisive(self) -> bool:
        """Whether the evidence is so strong that no other candidate need be registered."""
        return self.credible and self.log_odds >= DECISIVE


def decide(
    query: PlaceQuery,
    candidates: list[PlaceCandidate],
    registered: list[VerifiedCandidate],
    stages: dict[str, float],
) -> Relocalization | None:
    """The best of the registered candidates (at least one, best first) as the result; None if it is
    not credible, or if another has comparable evidence. candidates: the competitors; stages:
    seconds.
    """
    best = registered[0]
    if not best.credible:
        return None
    elsewhere = [j for j in registered[1:] if _distance(j.result, best.result) > SAME_PLACE_M]
    rival = max((j.result.quality for j in elsewhere), default=0.0)
    # Candidates that registration brings to one place are one: its score is the best of theirs.
    same = {j.rank for j in registered if _distance(j.result, best.result) <= SAME_PLACE_M}
    own = max(candidates[rank].score for rank in same)
    others = {k: c.score for k, c in enumerate(candidates) if k not in same}
    alike = {k for k, score in others.items() if score >= NEARLY * own}
    in_doubt = not best.is_decisive or any(j.credible for j in elsewhere)
    # Where houses are all alike and the right one is none of the candidates, the frame fits several
    # as badly: the winner must stand out from all that look nearly as much like it.
    stands_out = (
        alike <= {j.rank for j in registered} and best.result.quality >= _STANDS_OUT * rival
    )
    if in_doubt and not stands_out:
        return None
    return Relocalization(
        best.result.world_from_camera,
        best.result.covariance,
        query.frame.exposure_time_ns,
        best.result.quality,
        best.result.overlap,
        own,
        max(others.values(), default=0.0),
        best.rank,
        rival,
        stages,
    )


def _distance(a: Registration, b: Registration) -> float:
    """Distance between two registered positions, m."""
    away = a.world_from_camera.translation - b.world_from_camera.translation
    return float(np.linalg.norm(away))


__all__ = ["CREDIBLE", "DECISIVE", "NEARLY", "SAME_PLACE_M", "VerifiedCandidate", "decide"]
