"""What a calibration says of the receiver under whose places it was made."""

from __future__ import annotations

import pytest

from companion.calibrate.flight import receiver_bias_m


def test_a_receivers_error_is_of_the_whole_flight_and_not_of_its_last_picture() -> None:
    """It said 3 m for two minutes and 0.6 m at the end: the last alone is 5 times too sure."""
    assert receiver_bias_m([3.0] * 120 + [0.6]) == pytest.approx(2.98, abs=0.01)
    assert receiver_bias_m([0.6] * 120 + [3.0]) == pytest.approx(0.62, abs=0.01)


def test_a_receiver_that_says_little_or_nothing_is_not_believed_to_be_perfect() -> None:
    assert receiver_bias_m([]) == receiver_bias_m([None, 0.01]) == 0.5
