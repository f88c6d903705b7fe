"""What each acceptance lets through and what it costs, with exact intervals; table and JSON."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.common.shares import exact_interval
from benchmarks.integrity.beginnings import WRONG
from benchmarks.integrity.run import StartOutcome
from localizer.integrity.acceptance import IntegrityConfig, ambiguity

Acceptance = Callable[[StartOutcome], bool]

WITHOUT, LIKELY = "overlap and prediction alone", "log odds, any prior"
DISTINCT, FOCAL = "log odds by the prior: ours", "log odds, no other focal length"
OURS = "both: ours on trial"
COLUMNS = ("set", "acceptance", "accepted, > 3 m or 3° off", "> 10 m off", "right ones lost")

# What is put together beside all: a picture cannot tell a focal length from a distance, nor one of
# many equal roofs from the next.
_TOGETHER: dict[str, Acceptance] = {
    "all": lambda o: True,
    "all, focal length right": lambda o: not o.kind.startswith("focal"),
    "all, focal length right, no equal roofs": lambda o: (
        not o.kind.startswith("focal") and o.set != "roofs"
    ),
}


def acceptances(config: IntegrityConfig) -> dict[str, Acceptance]:
    """What is accepted without the evidence, that with each test added, and all of them."""
    c = config

    def plain(o: StartOutcome) -> bool:
        return o.ok and o.overlap >= c.min_overlap and o.gate <= c.chi2_threshold

    def likely(o: StartOutcome, ambiguous: float = 0.0) -> bool:
        return plain(o) and o.log_odds >= c.min_log_odds + ambiguous

    def by_prior(o: StartOutcome) -> bool:
        return likely(o, ambiguity(c, o.prior_sigma_m))

    def focal(o: StartOutcome) -> bool:
        return o.focal_gain <= c.max_focal_gain

    return {
        WITHOUT: plain,
        LIKELY: likely,
        DISTINCT: by_prior,
        FOCAL: lambda o: likely(o) and focal(o),
        OURS: lambda o: by_prior(o) and focal(o),
    }


@dataclass(frozen=True)
class Rate:
    """So many of so many, with the exact 95 % interval of the share in per cent."""

    hits: int
    count: int
    low: float
    high: float

    @classmethod
    def of(cls, hits: int, count: int) -> Rate:
        """With its interval."""
        return cls(hits, count, *exact_interval(hits, count))

    def __str__(self) -> str:
        share = 100 * self.hits / max(self.count, 1)
        return f"{self.hits} of {self.count}, {share:.2f} [{self.low:.2f}, {self.high:.2f}]"


@dataclass(frozen=True)
class AcceptanceRow:
    """One acceptance on one set. false: accepted, and off by more than 3 m or 3 degrees, of wrong
    beginnings; false_far: by more than 10 m; lost: of the right results that are accepted without
    any added test, those that this one rejects.
    """

    set: str
    acceptance: str
    false: Rate
    false_far: Rate
    lost: Rate


def rows(outcomes: Sequence[StartOutcome], config: IntegrityConfig) -> list[AcceptanceRow]:
    """Every acceptance, on each set and on all of them."""
    made = []
    tests = acceptances(config)
    for name in [*dict.fromkeys(o.set for o in outcomes), *_TOGETHER]:
        belongs = _TOGETHER.get(name, lambda o, name=name: o.set == name)
        mine = [o for o in outcomes if belongs(o)]
        wrong = [o for o in mine if o.kind in WRONG]
        right = [o for o in mine if o.right and tests[WITHOUT](o)]
        for label, accepts in tests.items():
            false = [o for o in wrong if not o.right and accepts(o)]
            lost = sum(not accepts(o) for o in right)
            made.append(
                AcceptanceRow(
                    name,
                    label,
                    Rate.of(len(false), len(wrong)),
                    Rate.of(sum(o.far for o in false), len(wrong)),
                    Rate.of(lost, len(right)),
                )
            )
    return made


def cells(made: Sequence[AcceptanceRow]) -> list[tuple[str, ...]]:
    """As `COLUMNS` names them: all acceptances over all sets, and ours on each set."""
    return [
        (r.set, r.acceptance, str(r.false), str(r.false_far), str(r.lost))
        for r in made
        if r.set in _TOGETHER or r.acceptance == OURS
    ]
