"""The budget's constants from one half of the frames, and the share covered of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.optimize import minimize

from benchmarks.common.shares import exact_interval
from benchmarks.protection.run import FaultOutcome
from companion.integrity_monitor.config import ProtectionConfig
from companion.integrity_monitor.protection import budget

RISKS = (0.05, 0.01, 1e-3)
_STARTS = (0.3, 0.005, 0.01)
_LEAST = 1e-6


@dataclass(frozen=True)
class Fitted:
    """One sigma of map, calibration (share of the height) and time, as in `ProtectionConfig`."""

    map_m: float
    map_height_m: float
    calibration_share: float
    time_bias_s: float

    def config(self, risk: float) -> ProtectionConfig:
        """As the monitor takes it, whatever the lens."""
        share = self.calibration_share
        return ProtectionConfig(risk=risk, calibrated_share=share, **asdict(self))


def halves(outcomes: Sequence[FaultOutcome]) -> tuple[list[FaultOutcome], list[FaultOutcome]]:
    """Accepted frames by view, even and odd: no picture is in both."""
    used = [o for o in outcomes if o.accepted]
    return [o for o in used if o.view % 2 == 0], [o for o in used if o.view % 2]


def total_m(outcome: FaultOutcome) -> tuple[float, float]:
    """Horizontal and vertical error, all sources together, metres."""
    east, north, up = (a + b for a, b in zip(outcome.error_m, outcome.beside_m, strict=True))
    return float(np.hypot(east, north)), abs(up)


def fitted(outcomes: Sequence[FaultOutcome]) -> Fitted:
    """Greatest likelihood: per axis a normal error of the summed variances."""
    squared = np.array([_squares(o) for o in outcomes])
    given = np.array([[o.sigma_m[0] ** 2, o.sigma_m[1] ** 2] for o in outcomes])
    height = np.array([o.height_m for o in outcomes]) ** 2
    speed = np.array([o.speed_mps for o in outcomes]) ** 2

    def cost(logs: np.ndarray) -> float:
        map2, up2, share2, late2 = np.exp(2.0 * logs)
        across = given[:, 0] + map2 + share2 * height + late2 * speed
        upwards = given[:, 1] + up2 + share2 * height
        ll = np.log(across) + 0.5 * squared[:, 0] / across
        ll += 0.5 * (np.log(upwards) + squared[:, 1] / upwards)
        return float(ll.sum())

    found = minimize(cost, np.log([_STARTS[0], *_STARTS]), method="Nelder-Mead",
                     options={"maxiter": 4000, "xatol": 1e-4, "fatol": 1e-4})  # fmt: skip
    across, up, share, late = (max(float(v), _LEAST) for v in np.exp(found.x))
    return Fitted(across, up, share, late)


def _squares(outcome: FaultOutcome) -> tuple[float, float]:
    horizontal, vertical = total_m(outcome)
    return horizontal**2, vertical**2


@dataclass(frozen=True)
class Coverage:
    """Of so many frames, how many errors were within HPL and VPL; low, high: exact 95 % interval of
    the horizontal share, per cent.
    """

    risk: float
    frames: int
    within_hpl: int
    within_vpl: int
    low: float
    high: float
    hpl_median_m: float
    vpl_median_m: float
    worst_share: float


def coverage(outcomes: Sequence[FaultOutcome], config: ProtectionConfig) -> Coverage:
    """How often the error is within the level at the configured risk."""
    levels = np.array([_level(o, config) for o in outcomes])
    errors = np.array([total_m(o) for o in outcomes])
    inside = errors <= levels
    hits, n = int(inside[:, 0].sum()), len(outcomes)
    low, high = exact_interval(hits, n)
    return Coverage(
        config.risk, n, hits, int(inside[:, 1].sum()), low, high,
        float(np.median(levels[:, 0])), float(np.median(levels[:, 1])),
        float((errors[:, 0] / levels[:, 0]).max()),
    )  # fmt: skip


def _level(o: FaultOutcome, config: ProtectionConfig) -> tuple[float, float]:
    """By the budget of its lens, as the flight's table chooses it by the deployment."""
    config = config.of_camera(calibrated=o.lens != "careful")
    return budget(o.sigma_m, o.height_m, (o.speed_mps, 0.0), config)


def along_axis(outcomes: Sequence[FaultOutcome]) -> tuple[float, float]:
    """Of a focal length that is long by `focal`: by how many times focal x depth the position is
    behind along the optical axis, median, and the median of what is left across, same units.
    """
    back, across = [], []
    for o in outcomes:
        error, axis = np.array(o.error_m), np.array(o.axis)
        unit = o.focal * o.depth_m
        back.append(-float(error @ axis) / unit)
        across.append(float(np.linalg.norm(error - axis * (error @ axis))) / abs(unit))
    return float(np.median(back)), float(np.median(across))
