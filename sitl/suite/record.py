"""Record of a flight of the suite: plain lists, stored as JSON.

Seconds count from the moment when the take-off height is reached (on the ground: from the start of
injection), in simulated time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import alert_of, values_of
from mavlink_bridge.messages import Figures

Array = NDArray[np.float64]
_AUTOPILOT = 1  # component id
_WARNING = 4  # MAV_SEVERITY; lower is worse


@dataclass(frozen=True)
class Text:
    """A STATUSTEXT and the MAVLink component that sent it: the autopilot, or our processes."""

    at_s: float
    component: int
    severity: int
    text: str

    @property
    def is_ours(self) -> bool:
        """Whether the bridge sent it, not the autopilot."""
        return self.component != _AUTOPILOT

    @property
    def alert(self) -> AlertId | None:
        """Our alert, raised or cleared; None for texts of the autopilot."""
        read = alert_of(self.text) if self.is_ours else None
        return None if read is None else read[0]

    @property
    def raised(self) -> tuple[AlertId, dict[str, str]] | None:
        """Our active alert and its values as shown; None for others."""
        return values_of(self.text) if self.is_ours else None

    @property
    def is_warning(self) -> bool:
        """Whether it is a warning of ours, or worse."""
        return self.is_ours and self.severity <= _WARNING


@dataclass(frozen=True)
class VehicleSample:
    """State of the flight, sampled at 10 Hz. north, east: true metres from home; vehicle_s: seconds
    since the vehicle's boot.
    """

    at_s: float
    north_m: float
    east_m: float
    mode: str
    armed: bool
    injected: int
    source_set: int
    vehicle_s: float


@dataclass(frozen=True)
class Doctor:
    """Wrong parameters before (`found`) and after (`left`) ``doctor --fix``, and exit codes."""

    found: tuple[str, ...]
    left: tuple[str, ...]
    exit_before: int
    exit_after: int


@dataclass
class CaseRecord:
    """Record of one scenario's flight. errors: (seconds, north, east) of every EKF position against
    the truth of its time.

    refusals: texts of the last refused arming; None if arming was not tried or accepted. pace:
    lowest ratio of simulated to real time over ten seconds. Below 1 the computer was too slow, and
    the autopilot's clock ran slow against the bridge's. stall_s: largest delay of the vehicle
    within one second.
    """

    errors: list[tuple[float, float, float]] = field(default_factory=list)
    samples: list[VehicleSample] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)
    refusals: list[str] | None = None
    doctor: Doctor | None = None
    counters: Figures = field(default_factory=dict)
    closed: bool = False
    pace: float = 1.0
    stall_s: float = 0.0

    @property
    def pace_text(self) -> str:
        """How far simulated time fell behind real time, as text."""
        return f"{self.pace:.2f} of real time over 10 s, {self.stall_s:.2f} s lost within a second"

    def horizontal(self, from_s: float = 0.0, to_s: float = np.inf) -> Array:
        """Horizontal EKF errors (N,) in metres within a span of seconds."""
        return np.array([np.hypot(n, e) for t, n, e in self.errors if from_s <= t <= to_s])

    def north(self, from_s: float, to_s: float) -> Array:
        """North EKF errors (N,) in metres within a span of seconds."""
        return np.array([n for t, n, _ in self.errors if from_s <= t <= to_s])

    def at(self, seconds: float) -> VehicleSample | None:
        """The first sample at or after a time, otherwise the last one; None without samples."""
        later = [s for s in self.samples if s.at_s >= seconds]
        return later[0] if later else (self.samples[-1] if self.samples else None)
