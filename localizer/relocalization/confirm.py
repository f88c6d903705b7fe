"""Selects the candidates to render and register, cheap tests first.

At half the image size a candidate costs a tenth of a registration, and the right position nearly
always has the best score. So all candidates are screened, and only the best are registered.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from localizer.integrity.probability import log_odds
from localizer.registration.result import failure
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.types import PlaceCandidate, PlaceQuery
from localizer.relocalization.verdict import NEARLY, SAME_PLACE_M, VerifiedCandidate
from localizer.relocalization.verify import Aligned, QueryFeatures, Verifier
from localizer.tracking.sensor_fusion import FusedRegistration
from localizer.types import PosePrior, RegistrationStatus

_ROUNDS = (3, 24)  # candidates screened before the best are registered; then all
_SAME_START = 1.0  # m and degrees: a registration from so near is the same one
_HOPELESS = 0.5  # of the best quality


class SearchCancelledError(Exception):
    """The search was cancelled."""


def competitors(
    candidates: list[PlaceCandidate], registered: list[VerifiedCandidate]
) -> list[PlaceCandidate]:
    """The candidates that a result must stand out from: the first of the search (whose scores need
    not descend), at least up to the last registered rank.
    """
    return candidates[: max(_ROUNDS[-1], *(j.rank + 1 for j in registered))]


@dataclass
class Confirmation:
    """The candidates of one query during confirmation. Use it once.

    full: the frame as the tracker uses it; small: the frame at the size of the screening. places:
    candidates screened so far; registered: candidates registered so far, by rank. surrounded,
    finished: ranks of the candidates that were registered from all sides, and in all passes.
    """

    verifier: Verifier
    full: QueryFeatures
    small: QueryFeatures
    query: PlaceQuery
    candidates: list[PlaceCandidate]
    config: RelocalizationConfig
    should_stop: Callable[[], bool]
    places: list[Aligned] = field(default_factory=list)
    registered: dict[int, VerifiedCandidate] = field(default_factory=dict)
    surrounded: set[int] = field(default_factory=set)
    finished: set[int] = field(default_factory=set)

    def run(self) -> list[VerifiedCandidate]:
        """The registered candidates, best first; the best one in all passes. Empty if cancelled."""
        try:
            self._first_pass()
            self._finish()
            order = self._order()
            # Only now: the last pass may leave a place in doubt that was decisive before.
            if order and order[0].credible and not order[0].is_decisive:
                self._screen(min(len(self.candidates), _ROUNDS[-1]))
                self._settle_alike(order[0])
                self._finish()
        except SearchCancelledError:
            return []
        return self._order()

    def _first_pass(self) -> None:
        """Screen and register more and more candidates until one is decisive."""
        most = min(len(self.candidates), self.config.candidates)
        few, several = (min(n, most) for n in _ROUNDS)
        self._screen(few)
        if few:
            self._register(self._best_placed()[0])
        if self._is_settled(self.candidates[few : _ROUNDS[-1]]):
            return
        for end in dict.fromkeys((several, most)):
            self._screen(end)
            for rank in self._best_placed()[: self.config.finalists]:
                self._register(rank)
                if self._leads():
                    return
            if not self._is_any_credible():
                self._look_around()
            if self._is_any_credible():
                break

    def _screen(self, end: int) -> None:
        for candidate in self.candidates[len(self.places) : end]:
            self._go_on()
            prior = self.verifier.prior(candidate, self.query)
            self.places.append(self.verifier.screen(self.small, prior))

    def _best_placed(self) -> list[int]:
        """Ranks of the screened candidates, best score first."""
        return sorted(range(len(self.places)), key=lambda k: -self.places[k].score)

    def _register(self, rank: int) -> None:
        """Register one candidate, once; candidates at the same position share a result."""
        if rank in self.registered:
            return
        self._go_on()
        place = self.places[rank]
        for other, done in self.registered.items():
            metres, degrees = self._apart(rank, other)
            if other not in self.surrounded and max(metres, degrees) <= _SAME_START:
                candidate = self.candidates[rank]
                self.registered[rank] = replace(done, rank=rank, candidate=candidate)
                if other in self.finished:
                    self.finished.add(rank)
                return
        self.registered[rank] = self._verified(
            rank, *self.verifier.register_aligned(self.full, place, self.query)
        )

    def _look_around(self) -> None:
        """Register the best candidates from all sides, because some converge from one side only."""
        for rank in self._best_placed()[: self.config.finalists]:
            if rank in self.surrounded or rank not in self.registered:
                continue
            self._go_on()
            self.surrounded.add(rank)
            begun = self.registered[rank]
            better = self._verified(
                rank, begun.prior, self.verifier.register_around(self.full, begun.prior, self.query)
            )
            if better.log_odds > begun.log_odds:
                self.registered[rank] = better

    def _settle_alike(self, best: VerifiedCandidate) -> None:
        """Register the other candidates whose ground looks nearly as much like the frame as the
        best one's, to test whether that is unique. A candidate whose rendering does not look like
        the frame is not registered and counts as different.
        """
        for rank, place in enumerate(self.places):
            if self.candidates[rank].score < NEARLY * best.candidate.score:
                continue
            if place.score >= NEARLY * self.places[best.rank].score:
                self._register(rank)
            elif rank not in self.registered:
                none = failure(place.prior, RegistrationStatus.NOT_TRIED)
                self.registered[rank] = self._verified(rank, place.prior, FusedRegistration(none))

    def _finish(self) -> None:
        """Run the further passes of the best candidates, each once."""
        order = sorted(self.registered.values(), key=lambda j: -j.result.quality)
        for j in order[: self.config.finalists]:
            hopeless = j.result.quality < _HOPELESS * order[0].result.quality
            if j.rank in self.finished or hopeless:
                continue
            self.finished.add(j.rank)
            self.registered[j.rank] = self._further(j)

    def _further(self, begun: VerifiedCandidate) -> VerifiedCandidate:
        j = begun
        for _ in range(self.config.passes - 1):
            self._go_on()
            if not math.isfinite(j.result.score):
                break
            prior = self.verifier.next_prior(j.prior, j.result)
            result = self.verifier.register(self.full, prior, self.query)
            j = self._verified(j.rank, prior, result)
        return j

    def _order(self) -> list[VerifiedCandidate]:
        return sorted(self.registered.values(), key=lambda j: (-int(j.credible), -j.log_odds))

    def _is_any_credible(self) -> bool:
        return any(j.credible for j in self.registered.values())

    def _is_settled(self, left: list[PlaceCandidate]) -> bool:
        """Whether the candidates `left` need not be examined: one of the first few is decisive, and
        no other ground looks nearly as much like the frame (as with equal roofs).
        """
        decisive = [j.candidate.score for j in self._decisive()]
        return bool(decisive) and all(c.score < NEARLY * max(decisive) for c in left)

    def _leads(self) -> bool:
        """Whether no other screened candidate's rendering looks nearly as much like the frame."""
        for winner in self._decisive():
            enough = NEARLY * self.places[winner.rank].score
            if all(
                place.score < enough or self._apart(k, winner.rank)[0] <= SAME_PLACE_M
                for k, place in enumerate(self.places)
                if k not in self.registered
            ):
                return True
        return False

    def _decisive(self) -> list[VerifiedCandidate]:
        return [j for j in self.registered.values() if j.is_decisive]

    def _verified(self, rank: int, prior: PosePrior, found: FusedRegistration) -> VerifiedCandidate:
        candidate, result = self.candidates[rank], found.registration
        credible = self.verifier.is_credible(found, candidate, self.query)
        return VerifiedCandidate(candidate, rank, result, prior, log_odds(result), credible)

    def _apart(self, a: int, b: int) -> tuple[float, float]:
        """Distance of two screened candidates' poses: metres and degrees."""
        first, second = (self.places[k].prior.world_from_camera for k in (a, b))
        return first.distance_to(second)

    def _go_on(self) -> None:
        if self.should_stop():
            raise SearchCancelledError
