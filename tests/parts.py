"""The suite in two parts: `python -m tests.parts [pytest's arguments]`, as `make test` calls it.

What only computes runs first, on two cores. What meets real time, a vehicle, a port of its own or a
browser runs after it in one process, with the machine to itself. Each part prints its own summary;
a failure of the first does not keep the second from running. `pytest` alone runs both as one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

COMPUTING, REAL_TIME = "computing", "real-time"

# Files and folders whose tests run alone; every other test only computes.
RUNS_ALONE = (
    "tests/companion/console/test_browser.py",
    "tests/companion/flight/test_app.py",
    "tests/companion/live",
    "tests/companion/offline/test_replay.py",
    "tests/companion/preflight/test_coverage.py",
    "tests/companion/sources/test_datagrams.py",
    "tests/companion/sources/test_live_stream.py",
    "tests/companion/sources/test_recorded.py",
    "tests/companion/sources/test_rtsp.py",
    "tests/companion/supervision",
    "tests/companion/targets/test_detections.py",
    "tests/companion/targets/test_reporter.py",
    "tests/companion/terminal",
    "tests/examples/test_bridge_examples.py",
    "tests/examples/test_detector_client.py",
    "tests/mavlink_bridge/link/test_link.py",
    "tests/mavlink_bridge/link/test_routing.py",
    "tests/mavlink_bridge/link/test_tlog.py",
    "tests/mavlink_bridge/preflight",
    "tests/mavlink_bridge/test_attacks.py",
    "tests/mavlink_bridge/test_bridge.py",
    "tests/mavlink_bridge/test_faults.py",
    "tests/mavlink_bridge/vehicle/test_last_words.py",
    "tests/mavlink_bridge/vehicle/test_presence.py",
    "tests/sitl/camera/test_detector.py",
    "tests/sitl/camera/test_process.py",
    "tests/sitl/camera/test_realism.py",
    "tests/sitl/demo/test_flight.py",
    "tests/sitl/embedded/test_protocols.py",
    "tests/sitl/ground/test_pilot.py",
    "tests/sitl/suite/test_flights.py",
    "tests/sitl/suite/test_loop_flights.py",
    "tests/sitl/vehicles",
    "tests/test_real_time.py",
)

# Where both parts find what is dear to build (tests/conftest.py); a folder that lives as long.
SHARED_FOLDER = "PILOT_TEST_SHARED"

# A file's tests share its fixtures, so one worker runs them; a core for each of two workers.
_WORKERS = ("--numprocesses=2", "--dist=loadfile")
_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

_PASSED, _NOTHING_RAN = 0, 5  # pytest's exit codes


def part_of(path: str) -> str:
    """The part to which a test file belongs; its path as POSIX from the repository's root."""
    file = PurePosixPath(path)
    alone = any(file.is_relative_to(entry) for entry in RUNS_ALONE)
    return REAL_TIME if alone else COMPUTING


def together(codes: Sequence[int]) -> int:
    """One exit code of both parts: the first that tells of a problem.

    A part that has none of the tests asked for passes, unless no part has any.
    """
    problems = [code for code in codes if code not in (_PASSED, _NOTHING_RAN)]
    return problems[0] if problems else min(codes)


def main(arguments: Sequence[str]) -> int:
    """Run both parts with pytest's arguments; pytest's exit code."""
    with tempfile.TemporaryDirectory(prefix="tests-") as shared:
        common = {**os.environ, SHARED_FOLDER: str(Path(shared).resolve())}
        codes = {
            COMPUTING: _run(COMPUTING, [*_WORKERS, *arguments], common | _ONE_CORE),
            REAL_TIME: _run(REAL_TIME, arguments, common),
        }
    outcome = ", ".join(f"{part} part: {_word(code)}" for part, code in codes.items())
    print(outcome, flush=True)
    return together(list(codes.values()))


def _run(part: str, arguments: Sequence[str], environment: Mapping[str, str]) -> int:
    command = [sys.executable, "-m", "pytest", f"--part={part}", *arguments]
    return subprocess.run(command, env=environment, check=False).returncode


def _word(code: int) -> str:
    return {_PASSED: "passed", _NOTHING_RAN: "no tests asked for"}.get(code, f"FAILED ({code})")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
