"""Runs the console's process during a flight.

A crash is reported once and not restarted: `companion console` starts it again. A pipe ends it if
the flight process ends for any reason.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from companion.live.config import ConsoleConfig

_log = logging.getLogger("companion.console")
_STOP_S = 3.0
_NEEDED = ("starlette", "uvicorn", "websockets")


@contextlib.contextmanager
def running_console(deployment: Path, config: ConsoleConfig | None) -> Iterator[None]:
    """Context manager: serve the web page in a process of its own, which ends with it; nothing if
    `config` is None. If the page cannot be served, the log says so and the flight continues.
    """
    ending = threading.Event()
    process = None if config is None else _begun(deployment, config, ending)
    try:
        yield
    finally:
        ending.set()
        if process is not None:
            _end(process)


def _begun(
    deployment: Path, config: ConsoleConfig, ending: threading.Event
) -> subprocess.Popen[bytes] | None:
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        _log.warning("no console: install pilot-companion[console] (%s missing)", missing[0])
        return None
    command = [sys.executable, "-m", "companion", "console", str(deployment), "--lifeline"]
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            start_new_session=True,  # an interrupt at the terminal is the flight's
        )  # fmt: skip
    except OSError as error:
        _log.warning("no console: %s", error)
        return None
    _log.info("console: %s", config.url)
    told = threading.Thread(
        target=_tell_end, args=(process, ending), name="console end", daemon=True
    )
    told.start()
    return process


def _tell_end(process: subprocess.Popen[bytes], ending: threading.Event) -> None:
    assert process.stderr is not None
    last = b""
    for line in process.stderr:
        last = line.strip() or last
    code = process.wait()
    if ending.is_set():
        return
    why = last.decode("utf-8", "replace")[:300] if code > 0 else ""
    what = signal.Signals(-code).name if code < 0 else str(code)
    _log.warning("the console ended (%s): %s", what, why or "`companion console` begins it again")


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
