"""What each acceptance lets through and what it costs, with exact intervals; table, JSON, plot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.common.shares import exact_interval
from benchmarks.integrity.beginnings import WRONG
from benchmarks.integrity.run import StartOutcome
from localizer.integrity.acceptance import IntegrityConfig

Acceptance = Callable[[StartOutcome], bool]

WITHOUT, AGREE = "no added test", "parts agree"
DISTINCT, FOCAL = "parts agree, stands out: ours", "parts agree, no other focal length"
OURS = "all three: ours on trial"

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
    """What was accepted without the parts' votes, that with each test added, and all of them."""
    c = config

    def plain(o: StartOutcome) -> bool:
        good = o.ok and o.overlap >= c.min_overlap and o.quality >= c.min_quality
        return good and o.sigma_m <= c.max_sigma_m and o.gate <= c.chi2_threshold

    def votes(o: StartOutcome, share: float) -> bool:
        return plain(o) and o.parts >= c.min_patches and o.votes >= share * o.parts

    def focal(o: StartOutcome) -> bool:
        return o.focal_gain <= c.max_focal_gain

    def stands_out(o: StartOutcome) -> bool:
        return o.prior_sigma_m < c.ambiguity_sigma_m or o.peak >= c.peak_to_sidelobe_min

    return {
        WITHOUT: plain,
        "second mode 5 % worse": lambda o: plain(o) and o.lead >= 0.05,
        "quality 0.3": lambda o: plain(o) and o.quality >= 0.3,
        "peak 4.5": lambda o: plain(o) and o.peak >= 4.5,
        "55 % of parts agree": lambda o: votes(o, 0.55),
        AGREE: lambda o: votes(o, c.min_patch_inlier_ratio),
        DISTINCT: lambda o: votes(o, c.min_patch_inlier_ratio) and stands_out(o),
        FOCAL: lambda o: votes(o, c.min_patch_inlier_ratio) and focal(o),
        OURS: lambda o: votes(o, c.min_patch_inlier_ratio) and focal(o) and stands_out(o),
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


def table(made: Sequence[AcceptanceRow]) -> str:
    """Shares in per cent with their intervals."""
    lines = [
        "| set | acceptance | accepted, > 3 m or 3° off | > 10 m off | right ones lost |",
        "|---|---|---|---|---|",
    ]
    lines += [f"| {r.set} | {r.acceptance} | {r.false} | {r.false_far} | {r.lost} |" for r in made]
    return "\n".join(lines)


def by_condition(outcomes: Sequence[StartOutcome], config: IntegrityConfig) -> str:
    """Right results lost by our tests, of each condition, and of a focal length that is 5 % off."""
    tests = acceptances(config)
    lines = ["| right results | lost by our tests, % |", "|---|---|"]
    for condition in sorted({o.condition for o in outcomes}):
        mine = [o for o in outcomes if o.condition == condition and o.right and tests[WITHOUT](o)]
        lost = sum(not tests[OURS](o) for o in mine)
        lines.append(f"| {condition} | {Rate.of(lost, len(mine))} |")
    focal = [o for o in outcomes if o.kind == "focal near"]
    for label in (WITHOUT, AGREE, OURS):
        false = sum(tests[label](o) and not o.right for o in focal)
        lines.append(
            f"| focal length 5 % off, begun right: accepted > 3 m off, {label} "
            f"| {Rate.of(false, len(focal))} |"
        )
    return "\n".join(lines)


def plot(outcomes: Sequence[StartOutcome], config: IntegrityConfig, path: Path) -> None:
    """Share of agreeing parts over quality, of right and of wrong results."""
    figure, axes = plt.subplots(figsize=(7, 5))
    seen = [o for o in outcomes if o.ok and o.parts]
    for label, right, colour in (("wrong", False, "tab:red"), ("right", True, "tab:green")):
        mine = [o for o in seen if o.right is right and (right or o.far)]
        x, y = [o.quality for o in mine], [o.votes / o.parts for o in mine]
        axes.scatter(np.array(x), np.array(y), s=3, color=colour, label=f"{label}, {len(mine)}")
    axes.axhline(config.min_patch_inlier_ratio, color="black", ls="--", lw=0.8)
    axes.axvline(config.min_quality, color="black", ls=":", lw=0.8)
    axes.set_xlabel("registration quality")
    axes.set_ylabel("share of the image's parts that agree")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)
