"""Parameters of the vehicle that go from one value to another during a flight."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field, model_validator

from mavlink_bridge.config import StrictModel

_STEP_S = 0.4


class Ramp(StrictModel):
    """Base of a scenario's events. ramp: parameters that go linearly from one value to another in
    over_s. scattered: parameters of the ramp that are drawn at each step, uniform within plus or
    minus the value that is due.
    """

    ramp: dict[str, tuple[float, float]] = Field(default_factory=dict)
    over_s: float = Field(0.0, ge=0, le=600)
    scattered: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _belongs_together(self) -> Ramp:
        if not set(self.scattered) <= set(self.ramp) or bool(self.ramp) != (self.over_s > 0):
            raise ValueError("over_s belongs to a ramp, and `scattered` names parameters of it")
        return self

    def values(self, share: float, rng: np.random.Generator) -> dict[str, float]:
        """The parameters at a share (0 to 1) of over_s."""
        due = {name: first + share * (last - first) for name, (first, last) in self.ramp.items()}
        return {
            name: value * float(rng.uniform(-1, 1)) if name in self.scattered else value
            for name, value in due.items()
        }


class RunningRamp:
    """The running ramp; a new one replaces it. seed: of the scattered values."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._ramp, self._begun_s, self._due_s = Ramp(), 0.0, math.inf

    def begin(self, event: Ramp, now_s: float) -> None:
        """Begin the event's ramp; an event without a ramp changes nothing."""
        if event.ramp:
            self._ramp, self._begun_s, self._due_s = event, now_s, now_s

    def due(self, now_s: float) -> dict[str, float]:
        """Parameters to set now; empty between the steps."""
        if now_s < self._due_s:
            return {}
        share = min((now_s - self._begun_s) / self._ramp.over_s, 1.0)
        self._due_s = self._due_s + _STEP_S if share < 1.0 else math.inf
        return self._ramp.values(share, self._rng)
