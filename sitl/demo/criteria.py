"""What a demo flight has to reach, and whether it did."""

from __future__ import annotations

from dataclasses import dataclass

from localizer.evaluation.metrics import LocalizationMetrics
from sitl.demo.analysis import Spread

_MAX_LATENCY_MS = 250.0  # the oldest measurement that ArduPilot fuses; VISO_DELAY_MS's maximum


@dataclass(frozen=True)
class Criterion:
    """One target: a value that must reach (`at_least`) or stay within a limit."""

    name: str
    value: float | None
    limit: float
    unit: str
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """Whether it holds; a value that is not known does not."""
        if self.value is None:
            return False
        if self.at_least:
            return self.value >= self.limit
        return self.value <= self.limit


def judge(localizer: LocalizationMetrics, ekf: Spread, fixed: Spread) -> tuple[Criterion, ...]:
    """The targets of a flight. ekf: horizontal, m; fixed: 3-D errors of targets that stand, m."""
    m = localizer
    return (
        Criterion("localizer median", m.median_translation_m, 1.0, "m"),
        Criterion("localizer R@3", m.recall_3, 95.0, "%", at_least=True),
        Criterion("completeness", m.completeness, 99.0, "%", at_least=True),
        Criterion("localized frames", m.fps, 8.0, "/s", at_least=True),
        Criterion("EKF horizontal p95", ekf.p95, 3.0, "m"),
        Criterion("fixed targets p95", fixed.p95, 3.0, "m"),
    )


def latency_warning(latency_ms: Spread, delay_ms: float) -> str | None:
    """A line if more than 5 per cent of the estimates come later than the bridge sends them.

    latency_ms: from exposure to estimate. delay_ms: ``bridge.injection.delay_ms``, the age at which
    a fix is sent and which VISO_DELAY_MS tells the EKF.
    """
    limit = min(delay_ms, _MAX_LATENCY_MS)
    p95 = latency_ms.p95
    if p95 is None or p95 <= limit:
        return None
    return (
        f"exposure to estimate takes {p95:.0f} ms at p95, above {limit:.0f} ms "
        f"(bridge.injection.delay_ms {delay_ms:.0f}, ArduPilot's limit {_MAX_LATENCY_MS:.0f}): "
        "later fixes are older than the EKF was told, and beyond its limit only extrapolated ones "
        "are sent; give the companion more processor, lower localizer.width or raise the delay"
    )
