"""Two detectors with one name for a target are two; one that was started again is the same."""

import pytest

from companion.targets.senders import Senders

A, B, C = ("127.0.0.1", 4000), ("127.0.0.1", 4001), ("10.0.0.2", 4000)
S = 1_000_000_000


def _named(senders, *order, name="car", step_ns=S // 10):
    return [senders.name_of(name, who, k * step_ns) for k, who in enumerate(order)]


def test_two_detectors_with_one_name_are_two():
    """Their targets were one, that leapt between two places."""
    told = _named(Senders(), A, B, A, B, A, B, C, B, C)
    assert told[2:6] == ["car", "car #2", "car", "car #2"]
    assert told[-2:] == ["car #2", "car #3"]


def test_other_names_are_not_touched():
    senders = Senders()
    _named(senders, A, B, A, B)
    assert _named(senders, A, A, name="van") == ["van", "van"]


@pytest.mark.parametrize(
    "order", [[A, A, A, B, B, B], [("127.0.0.1", port) for port in range(5000, 5400)]]
)
def test_a_detector_that_is_started_again_or_opens_a_socket_each_time_is_one(order):
    assert set(_named(Senders(), *order)) == {"car"}


def test_a_name_is_free_once_its_sender_is_silent():
    senders = Senders()
    _named(senders, A, B, A, B)
    assert senders.name_of("car", C, 100 * S) == "car"
