"""The console's log never stops and never ends a thread that logs."""

import logging
import os
import threading
import time
from contextlib import contextmanager

import pytest

from companion.terminal.console_log import OURS, WAITING, console_log

_log = logging.getLogger("companion.test")


@pytest.fixture(autouse=True)
def levels():
    """Put back what the process-wide loggers had."""
    loggers = [logging.getLogger(name) for name in ("", *OURS)]
    before = [logger.level for logger in loggers]
    yield
    for logger, level in zip(loggers, before, strict=True):
        logger.setLevel(level)


def _wait_for_the_console():
    """No thread may write any more when the number of its file gets free."""
    for thread in threading.enumerate():
        if thread.name == "console":
            thread.join(30.0)
            assert not thread.is_alive()


@contextmanager
def _pipe():
    """A pipe's two files."""
    read, write = os.pipe()
    with os.fdopen(write, "wb", 0) as writer:
        with os.fdopen(read, "rb", 0) as reader:
            yield reader, writer
        _wait_for_the_console()


@pytest.mark.parametrize("verbose", [False, True])
def test_verbose_holds_for_our_packages_only(verbose):
    with _pipe() as (read, write):
        with console_log(verbose, write.fileno()):
            assert logging.getLogger("mavlink_bridge.bridge").isEnabledFor(logging.DEBUG) == verbose
            assert not logging.getLogger("numba.core.ssa").isEnabledFor(logging.DEBUG)
            assert logging.getLogger("numba.core.ssa").isEnabledFor(logging.INFO)
            _log.warning("[/red] 5 of %d", 7)
        assert "[/red] 5 of 7" in read.read(4096).decode()


def _logs(lines):
    """A thread that logs so many lines; True if it came to its end."""
    done = threading.Event()

    def log():
        for i in range(lines):
            _log.info("line %d", i)
        done.set()

    thread = threading.Thread(target=log)
    thread.start()
    thread.join(60.0)
    return done.is_set()


def test_a_reader_that_ends_ends_nobody():
    """`companion run | tee log`, and tee is gone; rich would raise SystemExit in the thread."""
    with _pipe() as (read, write), console_log(False, write.fileno()):
        assert _logs(1)
        assert read.read(1)
        read.close()
        assert _logs(3)


def test_a_stopped_terminal_stops_nobody_and_the_end_is_not_waited_for():
    with _pipe() as (_, write):
        with console_log(False, write.fileno()):
            assert _logs(2 * WAITING)  # far more than a pipe and the queue hold
            began = time.monotonic()
        assert time.monotonic() - began < 30.0  # the terminal never reads on


def test_a_full_disk_stops_nobody():
    full = os.open("/dev/full", os.O_WRONLY)
    with console_log(False, full):
        assert _logs(10)
    _wait_for_the_console()
    os.close(full)
