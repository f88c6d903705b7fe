"""An operator's hint: what names a place is understood, anything else is denied."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.messages import PlaceHint
from mavlink_bridge.place_hint import PLACE_HINT, place_hint


def as_int(latitude: int, longitude: int, accuracy: float) -> mavlink.MAVLink_command_int_message:
    """COMMAND_INT to the localizer."""
    values = (0.0, 0.0, accuracy, 0.0, latitude, longitude, math.nan)
    return mavlink.MAVLink_command_int_message(1, 197, 0, PLACE_HINT, 0, 0, *values)


def as_long(latitude: float, longitude: float) -> mavlink.MAVLink_command_long_message:
    """COMMAND_LONG to the localizer, without an accuracy."""
    values = (0.0, 0.0, 0.0, 0.0, latitude, longitude, math.nan)
    return mavlink.MAVLink_command_long_message(1, 197, PLACE_HINT, 0, *values)


def test_a_hint_is_read_from_either_command() -> None:
    assert place_hint(as_int(474000000, 85000000, 50.0)) == PlaceHint(47.4, 8.5, 50.0)
    hint = place_hint(as_long(47.4, 8.5))
    assert hint is not None
    assert hint.latitude_deg == pytest.approx(47.4, abs=1e-5)
    assert hint.radius_m == 100.0


@pytest.mark.parametrize(("accuracy", "radius"), [(0.1, 10.0), (1e9, 20_000.0), (math.nan, 100.0)])
def test_an_absurd_accuracy_is_bounded(accuracy: float, radius: float) -> None:
    hint = place_hint(as_int(474000000, 85000000, accuracy))
    assert hint is not None
    assert hint.radius_m == radius


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(0.0, 0.0), (91.0, 8.5), (47.4, math.nan), (math.inf, 8.5)]
)
def test_what_names_no_place_is_no_hint(latitude: float, longitude: float) -> None:
    assert place_hint(as_long(latitude, longitude)) is None
