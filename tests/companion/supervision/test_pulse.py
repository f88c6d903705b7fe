"""The supervisor's signs of life: the part that is longest without a turn."""

from __future__ import annotations

import os
import sys
import threading
import time

import pytest

from companion.flight.feed import Feed
from companion.supervision.processes import ENDING, Beat, FlightProcess
from companion.supervision.pulse import Pulse, line


def test_the_oldest_turn_is_told() -> None:
    now_ns = 100_000_000_000
    last_ticks_ns = {
        "render": now_ns - 5_000_000,
        "link fc": now_ns - 7_100_000_000,
        "feed": now_ns + 9,
    }
    assert line(last_ticks_ns, now_ns) == b"link-fc 7100\n"
    assert line({}, now_ns) == b"all 0\n"


def test_a_pulse_is_read_and_a_supervisor_that_does_not_read_is_not_waited_for() -> None:
    reading, writing = os.pipe()
    beating = threading.Event()

    def last_ticks_ns() -> dict[str, int]:
        beating.set()
        return {}

    while True:  # until the pipe is full
        os.set_blocking(writing, False)
        try:
            os.write(writing, b"x" * 4096)
        except BlockingIOError:
            break
    pulse = Pulse(last_ticks_ns, writing)
    pulse.start()
    assert beating.wait(20.0)
    pulse.stop(clean_shutdown=True)
    os.close(reading)


@pytest.mark.parametrize("clean_shutdown", [True, False])
def test_the_last_word_says_whether_the_end_is_in_order(clean_shutdown: bool) -> None:
    reading, writing = os.pipe()
    pulse = Pulse(lambda: {}, writing)
    pulse.start()
    pulse.stop(clean_shutdown=clean_shutdown)
    last = os.read(reading, 4096).splitlines()[-1]
    os.close(reading)
    assert last == (f"{ENDING} 0" if clean_shutdown else "failing 0").encode()


def test_a_frame_that_a_part_keeps_is_seen() -> None:
    """The feed waits for the camera as long as it likes, and for no part."""
    taken, go = threading.Event(), threading.Event()

    class Source:
        def frames(self):  # type: ignore[no-untyped-def]
            yield object()

        def close(self) -> None:
            pass

    def keeps(_: object) -> None:
        taken.set()
        go.wait(20.0)

    feed = Feed(Source(), keeps)  # type: ignore[arg-type]
    feed.start()
    assert taken.wait(20.0)
    assert feed.last_tick_ns == feed.last_tick_ns
    go.set()
    feed.stop()
    assert feed.last_tick_ns < feed.last_tick_ns


def test_what_is_no_beat_is_no_sign_of_life() -> None:
    """The pipe is the process's own; a library that writes into it must not end the supervisor."""
    script = (
        "import os, sys; os.write(int(sys.argv[1][8:]), b'a 1\\nnonsense\\nb x\\nc 2500\\nd 1')"
    )
    process = FlightProcess([sys.executable, "-S", "-c", script], standby=False)
    assert process.wait(20.0) == 0
    assert process.beats() == (Beat("a", 0.001), Beat("c", 2.5))
    assert process.beats() == ()
    process.close()
    process.close()


def test_a_part_that_was_made_long_before_the_start_is_no_hang() -> None:
    """A slow computer compiles for half a minute between: the process was ended at its first beat,
    "hangs (health)", and would have been each time.
    """
    reading, writing = os.pipe()
    made_ns = time.monotonic_ns() - 60_000_000_000
    pulse = Pulse(lambda: {"health": made_ns, "feed": time.monotonic_ns()}, writing)
    pulse.start()
    first = os.read(reading, 100).split(b"\n")[0]
    pulse.stop(clean_shutdown=True)
    os.close(reading)
    name, age_ms = first.split()
    assert name == b"health"
    assert int(age_ms) < 30_000  # since the start, whatever the machine does meanwhile
