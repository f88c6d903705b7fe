"""An operator's hint: the accuracy that it claims is bounded (the rest: test_bridge.py)."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.place_hint import PLACE_HINT, place_hint


def as_int(latitude: int, longitude: int, accuracy: float) -> mavlink.MAVLink_command_int_message:
    """COMMAND_INT to the localizer."""
    values = (0.0, 0.0, accuracy, 0.0, latitude, longitude, math.nan)
    return mavlink.MAVLink_command_int_message(1, 197, 0, PLACE_HINT, 0, 0, *values)


@pytest.mark.parametrize(("accuracy", "radius"), [(0.1, 10.0), (1e9, 20_000.0), (math.nan, 100.0)])
def test_an_absurd_accuracy_is_bounded(accuracy: float, radius: float) -> None:
    hint = place_hint(as_int(474000000, 85000000, accuracy))
    assert hint.radius_m == radius
