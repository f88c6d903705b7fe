"""The suite in three parts: `python -m tests.parts [pytest's arguments]`, as `make test` calls it.

Most tests run first, two at a time. Beside them run those that fly a simulated vehicle without
pictures, which mostly wait, and mypy: the vehicles get a processor as soon as they want one, mypy
what is left. What streams pictures in real time or drives a browser runs after them, one at a time,
with the machine to itself. Each part prints its own summary with its slowest tests; a failure of
one does not keep the next from running. `pytest` alone runs all as one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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

# A file's tests share its fixtures, so one worker runs them; a core for each of two workers. Files
# are run in the order of tests/conftest.py. A worker that a test crashes is not replaced, because
# xdist would run that test again, for ever.
WORKERS = (
    "--numprocesses=2", "--dist=loadfile", "--no-loadscope-reorder", "--max-worker-restart=0",
)  # fmt: skip

# A test that hangs ends its process, and every thread's stack is printed.
PATIENCE_S = 900
_PATIENT = (f"faulthandler_timeout={PATIENCE_S}", "faulthandler_exit_on_timeout=true")
HANGS_END = tuple(f"--override-ini={setting}" for setting in _PATIENT)

_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

# Who waits for whom while the first part runs: vehicles come before its tests, and mypy last.
_PRIORITIES = {SIDE_BY_SIDE: 15, VEHICLES: 0, ALONE: 0}
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
    with tempfile.TemporaryDirectory(prefix="tests-") as shared:
        common = {**os.environ, SHARED_FOLDER: str(Path(shared).resolve())}
        if common.pop("PYTHONDONTWRITEBYTECODE", ""):
            # Each of some hundred processes would compile all its modules, 2 to 20 s of processor.
            common["PYTHONPYCACHEPREFIX"] = str(Path(shared, "bytecode").resolve())
        crowded = common | _ONE_CORE
        with (
            _beside(_MYPY, common) as types,
            _beside(_pytest(VEHICLES, [*WORKERS, *arguments]), crowded) as vehicles,
        ):
            first = _pytest(SIDE_BY_SIDE, [*WORKERS, *arguments])
            codes = {SIDE_BY_SIDE: subprocess.run(first, env=crowded, check=False).returncode}
        codes[VEHICLES] = vehicles.returncode
        last = subprocess.run(_pytest(ALONE, arguments), env=common, check=False)
        codes[ALONE] = last.returncode
    outcome = ", ".join(f"{part} part: {_word(code)}" for part, code in codes.items())
    print(f"types: {_word(types.returncode)}, {outcome}", flush=True)
    return together(list(codes.values())) or types.returncode


def _pytest(part: str, arguments: Sequence[str]) -> list[str]:
    options = (f"--part={part}", "--durations=25", *HANGS_END)
    priority = ("nice", "-n", str(_PRIORITIES[part]))
    return [*priority, sys.executable, "-m", "pytest", *options, *arguments]


@contextmanager
def _beside(
    command: Sequence[str], environment: Mapping[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command meanwhile; at the end it is waited for, and what it said is printed."""
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            process.wait()
            said.seek(0)
            print(said.read().decode(errors="replace"), end="", flush=True)


def _word(code: int) -> str:
    return {_PASSED: "passed", _NOTHING_RAN: "no tests asked for"}.get(code, f"FAILED ({code})")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
