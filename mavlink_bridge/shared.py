"""Objects that the handlers of all links share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain, count

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.camera.look_at import LookAt
from mavlink_bridge.config import BridgeConfig, Mode
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.link.clock import SteadyUtc, monotonic_ns
from mavlink_bridge.messages import HealthLevel, PlaceHint, TrackRequest
from mavlink_bridge.vehicle.tracker import VehicleTracker
from mavlink_bridge.vehicle_events import VehicleWatch

CLICKED = range(1, 1001)
"""Numbers of clicked targets. What a detector sees has those behind, up to `FURTHER_CLICKS`."""
FURTHER_CLICKS = 1_000_001


def clicked_numbers() -> Iterator[int]:
    """Endless iterator over target numbers for clicks, ascending: `CLICKED`, then from
    `FURTHER_CLICKS` on, so that they differ from those of detected targets.
    """
    return chain(CLICKED, count(FURTHER_CLICKS))


@dataclass(frozen=True)
class Shared:
    """Objects that the bridge shares with its links' handlers. report: sends an alert to the
    operator.

    enable: None unless the mode is ``rc``. clock: CLOCK_MONOTONIC, ns, or the clock of a record.
    """

    config: BridgeConfig
    geoid_separation_m: float
    utc: SteadyUtc
    tracker: VehicleTracker
    begun_ns: int
    health: Callable[[], HealthLevel]
    report: Callable[[Alert], None]
    on_track: Callable[[TrackRequest], None] | None
    on_hint: Callable[[PlaceHint], bool] | None
    watch: VehicleWatch
    enable: InjectionEnable | None
    look: LookAt
    clock: Callable[[], int] = monotonic_ns
    target_numbers: Iterator[int] = field(default_factory=clicked_numbers)
    """Of clicked targets, over all links; none is given twice."""

    def uptime_ms(self, now_ns: int) -> int:
        """Milliseconds since the bridge was made, for time_boot_ms fields: 32 bits, wrapped."""
        return (now_ns - self.begun_ns) // 1_000_000 & 0xFFFFFFFF

    def mode(self) -> Mode:
        """Current mode: off, shadow or inject; mode rc is resolved by the pilot's enable."""
        if self.enable is None:
            return self.config.mode
        return "inject" if self.enable.enabled else "shadow"
