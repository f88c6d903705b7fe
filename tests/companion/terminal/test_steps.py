"""In a log, work that is counted says what it is at within seconds, and does not flood."""

import io
import math
import threading
from types import SimpleNamespace

import pytest
from rich.console import Console

from companion.terminal.steps import show_count, show_work, tally


@pytest.fixture
def log(monkeypatch):
    """A console that is none, with a clock and a timer that the test moves."""
    state = SimpleNamespace(now=0.0, timers=[])

    class Timer:
        def __init__(self, seconds, call):
            self.seconds, self.call, self.is_cancelled = seconds, call, False
            state.timers.append(self)

        def start(self): ...

        def cancel(self):
            self.is_cancelled = True

    monkeypatch.setattr("companion.terminal.steps.threading.Timer", Timer)
    monkeypatch.setattr("companion.terminal.steps.time.monotonic", lambda: state.now)
    file = io.StringIO()
    return state, Console(file=file, force_terminal=False), file


def test_after_two_seconds_it_says_what_it_is_at_then_now_and_then_and_at_the_end(log):
    state, console, file = log
    with show_count(console, "localizing", begins="compiles [kernels]") as show:
        (timer,) = state.timers
        assert timer.seconds == 2.0
        state.now = 2.0
        timer.call()
        more = tally(show, 100)
        for i in range(100):
            state.now = 2.0 + 0.1 * i
            more()
    assert timer.is_cancelled
    assert file.getvalue().splitlines() == [
        "   2 s localizing: compiles [kernels]",
        "   7 s localizing: 51 of 100",
        "  12 s localizing: 100 of 100",
    ]


def test_work_that_cannot_be_counted_is_told_of_after_two_seconds_and_then_every_ten(
    log, monkeypatch
):
    state, console, file = log
    told = threading.Event()

    class Over:
        def wait(self, seconds):
            if state.now >= 20.0:
                told.set()
                return True
            state.now += seconds
            return False

        def set(self):
            state.now = math.inf

    fakes = SimpleNamespace(Event=Over, Thread=threading.Thread)
    monkeypatch.setattr("companion.terminal.steps.threading", fakes)
    with show_work(console, "hashing [tiles]"):
        assert told.wait(30.0)
    assert file.getvalue().splitlines() == [
        "   2 s hashing [tiles]", "  12 s hashing [tiles]", "  22 s hashing [tiles]",
    ]  # fmt: skip
    assert state.now == math.inf
