"""Which of the registered candidates is the place, if one is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.registration.result import Registration
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.types import PlaceCandidate, PlaceQuery, Relocalization
from localizer.types import PosePrior

NEARLY = 0.8  # of the winner's correlation: a place that has to be looked at, too
_STANDS_OUT = 1.5  # times the quality of any other place. Equal houses: 1.0 to 1.19
SAME_PLACE_M = 5.0  # answers that are closer are one


@dataclass(frozen=True)
class VerifiedCandidate:
    """A candidate after registration. prior: what the next pass begins from."""

    candidate: PlaceCandidate
    rank: int
    result: Registration
    prior: PosePrior
    credible: bool


def is_decisive(judged: VerifiedCandidate, config: RelocalizationConfig) -> bool:
    """Whether no other candidate can be better: all but a few parts of the image agree."""
    votes = judged.result.agreement
    return judged.credible and votes is not None and votes.share >= config.decisive_agreement


def answer(
    query: PlaceQuery,
    candidates: list[PlaceCandidate],
    judged: list[VerifiedCandidate],
    config: RelocalizationConfig,
    stages: dict[str, float],
) -> Relocalization | None:
    """The best of the judged (one at least, best first), if nothing speaks for another place."""
    best = judged[0]
    rivals = [
        j.result.quality
        for j in judged[1:]
        if j.credible and _distance(j.result, best.result) > SAME_PLACE_M
    ]
    rival = max(rivals, default=0.0)
    if not best.credible or best.result.quality < rival + config.margin:
        return None
    # Candidates that registration brings to one place are one: its score is the best of theirs.
    same = {j.rank for j in judged if _distance(j.result, best.result) <= SAME_PLACE_M}
    own = max(candidates[rank].score for rank in same)
    others = {k: c.score for k, c in enumerate(candidates) if k not in same}
    alike = {k for k, score in others.items() if score >= NEARLY * own}
    if alike and not is_decisive(best, config) and not _stands_out(best, alike, judged):
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


def _stands_out(best: VerifiedCandidate, alike: set[int], judged: list[VerifiedCandidate]) -> bool:
    """Whether the candidates whose ground looks nearly as much like the frame are all known not to
    be the place: each was registered, and nowhere else is nearly as good. Where houses are all
    alike and the right one is none of the candidates, the frame fits several as badly.
    """
    if not alike <= {j.rank for j in judged}:
        return False
    elsewhere = (
        j.result.quality for j in judged if _distance(j.result, best.result) > SAME_PLACE_M
    )
    return best.result.quality >= _STANDS_OUT * max(elsewhere, default=0.0)


def _distance(a: Registration, b: Registration) -> float:
    """Between two answers, m."""
    away = a.world_from_camera.translation - b.world_from_camera.translation
    return float(np.linalg.norm(away))


__all__ = ["NEARLY", "SAME_PLACE_M", "VerifiedCandidate", "answer", "is_decisive"]
