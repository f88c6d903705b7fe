"""Source of the page's data: a running flight, or a record."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from companion.live.protocol import Message

_TEN_MINUTES = 600
_EVENTS = 1000


@dataclass
class Newest:
    """The newest messages of a flight, and a short history. states, frames: counts by which a page
    notices new data.
    """

    hello: dict[str, Any] | None = None
    state: dict[str, Any] | None = None
    frame: Message | None = None
    states: int = 0
    frames: int = 0
    samples: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_TEN_MINUTES))
    events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_EVENTS))

    def add(self, message: Message) -> None:
        """Store a message of the flight by its kind; "hello" clears samples and events."""
        kind = message.head.get("kind")
        if kind == "hello":
            self.hello = message.head
            self.samples.clear()
            self.events.clear()
        elif kind == "frame":
            self.frame = message
            self.frames += 1
        elif kind == "state":
            self.state = message.head
            self.states += 1
            self.events.extend(message.head.get("events") or ())
            sample = sample_of(message.head)
            if not self.samples or sample["t"] - self.samples[-1]["t"] >= 0.95:
                self.samples.append(sample)

    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed; None if the flight does not hear it, False without one."""
        if self.hello is None:
            return False
        vehicle = (self.state or {}).get("vehicle") or {}
        return bool(vehicle.get("armed")) if vehicle.get("connected") else None


class ConsoleSource(ABC):
    """Data source of the console: a running flight or a record. newest: the data to show."""

    def __init__(self) -> None:
        self.newest = Newest()
        self._event = asyncio.Event()

    @property
    def is_connected(self) -> bool:
        """Whether the source delivers data now."""
        return True

    def watch(self, wanted: bool) -> None:  # noqa: B027
        """Request frames, or stop; without effect where frames come by themselves."""

    async def changed(self) -> None:
        """Wait until there are new data, or the connection changes."""
        await self._event.wait()

    @abstractmethod
    async def order(self, order: dict[str, Any]) -> tuple[bool, str]:
        """Send an order; returns whether it was executed, and a text."""

    @abstractmethod
    async def run(self) -> None:
        """Read the source until cancelled."""

    def _wake_waiters(self) -> None:
        """Wake everybody that waits in `changed`."""
        event, self._event = self._event, asyncio.Event()
        event.set()


def sample_of(state: dict[str, Any]) -> dict[str, Any]:
    """A sample of the plots from a state document: t in seconds UTC; None for unknown values."""
    estimate = state.get("estimate") or {}
    health = state.get("health") or {}
    integrity_monitor = health.get("guardian") or {}
    machine = state.get("machine") or {}
    vehicle = state.get("vehicle") or {}
    stages = estimate.get("stages_ms") or {}
    accepted = bool(estimate.get("accepted"))
    return {
        "t": (state.get("utc_ns") or 0) * 1e-9,
        "sigma_m": estimate.get("sigma_m") if accepted else None,
        "hpl_m": integrity_monitor.get("hpl_m"),
        "residual_m": state.get("gnss_residual_m"),
        "quality": estimate.get("quality"),
        "rate_hz": health.get("rate_hz"),
        **{name: stages.get(name) for name in ("reference", "extract", "register", "latency")},
        "cpu_percent": machine.get("cpu_percent"),
        "temperature_c": machine.get("temperature_c"),
        "vision": [estimate.get("latitude_deg"), estimate.get("longitude_deg")]
        if accepted else None,
        "autopilot": _place(vehicle, "latitude_deg", "longitude_deg"),
        "gnss": _place(vehicle, "gps_latitude_deg", "gps_longitude_deg")
        if (vehicle.get("gps_fix_type") or 0) >= 3 else None,
    }  # fmt: skip


def _place(vehicle: dict[str, Any], *keys: str) -> list[float] | None:
    values = [vehicle.get(key) for key in keys]
    return None if None in values else values  # type: ignore[return-value]  # no None in it
