"""CPU load during a flight; it ends after its time or with the flight."""

from __future__ import annotations

import os
import subprocess
import sys

from sitl.demo.companion_process import FlightCompanion
from sitl.suite.loop.case import Load

# Computes until its time is over: a process that outlived the flight would disturb the next one.
_BURNER = """
import sys, time
end = time.monotonic() + float(sys.argv[1])
while time.monotonic() < end:
    sum(range(10_000))
"""


class CpuLoad:
    """CPU load from now on: busy processes that share one processor with the companion."""

    def __init__(self, load: Load, companion: FlightCompanion) -> None:
        self._companion = companion
        self._all = os.sched_getaffinity(0)
        one = {min(self._all)}
        companion.confine(one)
        self._processes = [
            subprocess.Popen([sys.executable, "-c", _BURNER, str(load.for_s)])
            for _ in range(load.processes)
        ]
        for process in self._processes:
            os.sched_setaffinity(process.pid, one)

    def end(self) -> None:
        """Stop the busy processes and give the companion all processors back; idempotent."""
        for process in self._processes:
            process.kill()
            process.wait()
        self._companion.confine(self._all)
