"""The suite in three parts: `python -m tests.parts [pytest's arguments]`, as `make test` calls it.

Most tests run first, two at a time; then, likewise, those that fly a simulated vehicle without
pictures: each is content with a core that nobody else uses. What streams pictures in real time or
drives a browser runs after them, one at a time, with the machine to itself. Each part prints its
own summary with its slowest tests; a failure of one does not keep the next from running. `pytest`
alone runs all as one.

mypy runs beside the first part, in what its waiting tests leave of the processors, and is told
after it: most of a minute for which no test waits.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

SIDE_BY_SIDE, VEHICLES, ALONE = "side-by-side", "vehicles", "alone"
PARTS = (SIDE_BY_SIDE, VEHICLES, ALONE)

# Files and folders whose tests fly a simulated vehicle, without pictures.
FLIES = (
    "tests/companion/preflight/test_coverage.py",
    "tests/examples/test_bridge_examples.py",
    "tests/mavlink_bridge/link/test_mavproxy.py",
    "tests/mavlink_bridge/link/test_routing.py",
    "tests/mavlink_bridge/preflight/test_mission.py",
    "tests/mavlink_bridge/test_look_at.py",
    "tests/sitl/ground/test_pilot.py",
    "tests/sitl/suite/test_flights.py",
    "tests/sitl/vehicles",
)

# Those whose tests need the machine for themselves: pictures in real time, a browser, measured
# processors. Every other test is content with a core, and patient.
RUNS_ALONE = (
    "tests/companion/console/test_browser.py",
    "tests/companion/flight/test_app.py",
    "tests/companion/sources/test_rtsp.py",
    "tests/sitl/demo/test_flight.py",
    "tests/sitl/suite/test_loop_flights.py",
)

# Where the parts find what is dear to build (tests/conftest.py); a folder that lives as long.
SHARED_FOLDER = "PILOT_TEST_SHARED"

# A file's tests share its fixtures, so one worker runs them; a core for each of two workers. A
# worker that a test crashes is not replaced, because xdist would run that test again, for ever.
WORKERS = ("--numprocesses=2", "--dist=loadfile", "--max-worker-restart=0")

# A test that hangs ends its process, and every thread's stack is printed.
PATIENCE_S = 900
_PATIENT = (f"faulthandler_timeout={PATIENCE_S}", "faulthandler_exit_on_timeout=true")
HANGS_END = tuple(f"--override-ini={setting}" for setting in _PATIENT)

_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

# Behind everything else: the tests get a processor as soon as they want one.
_MYPY = ("nice", "-n", "19", sys.executable, "-m", "mypy")

_PASSED, _NOTHING_RAN = 0, 5  # pytest's exit codes


def part_of(path: str) -> str:
    """The part to which a test file belongs; its path as POSIX from the repository's root."""
    file = PurePosixPath(path)
    for part, entries in ((VEHICLES, FLIES), (ALONE, RUNS_ALONE)):
        if any(file.is_relative_to(entry) for entry in entries):
            return part
    return SIDE_BY_SIDE


def together(codes: Sequence[int]) -> int:
    """One exit code of all parts: the first that tells of a problem.

    A part that has none of the tests asked for passes, unless none has any.
    """
    problems = [code for code in codes if code not in (_PASSED, _NOTHING_RAN)]
    return problems[0] if problems else min(codes)


def main(arguments: Sequence[str]) -> int:
    """Run all parts with pytest's arguments; pytest's exit code, or mypy's if that alone failed."""
    with tempfile.TemporaryDirectory(prefix="tests-") as shared, _beside(_MYPY) as types:
        common = {**os.environ, SHARED_FOLDER: str(Path(shared).resolve())}
        codes = {SIDE_BY_SIDE: _run(SIDE_BY_SIDE, [*WORKERS, *arguments], common | _ONE_CORE)}
        types_code = _told(types)  # before what needs its processors for itself
        codes |= {
            VEHICLES: _run(VEHICLES, [*WORKERS, *arguments], common | _ONE_CORE),
            ALONE: _run(ALONE, arguments, common),
        }
    outcome = ", ".join(f"{part} part: {_word(code)}" for part, code in codes.items())
    print(f"types: {_word(types_code)}, {outcome}", flush=True)
    return together(list(codes.values())) or types_code


def _run(part: str, arguments: Sequence[str], environment: Mapping[str, str]) -> int:
    options = (f"--part={part}", "--durations=25", *HANGS_END)
    command = [sys.executable, "-m", "pytest", *options, *arguments]
    return subprocess.run(command, env=environment, check=False).returncode


def _beside(command: Sequence[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def _told(process: subprocess.Popen[bytes]) -> int:
    """Wait for its end and print what it said; its exit code."""
    said, _ = process.communicate()
    print(said.decode(errors="replace"), end="", flush=True)
    return process.returncode


def _word(code: int) -> str:
    return {_PASSED: "passed", _NOTHING_RAN: "no tests asked for"}.get(code, f"FAILED ({code})")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
