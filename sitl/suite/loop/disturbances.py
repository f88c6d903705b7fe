"""External disturbances of a flight: GNSS spoofing, CPU load.

Both end after their time or with the flight.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys

from sitl.geodesy import Location
from sitl.ground.link import GroundLink
from sitl.suite.loop.case import Drag, Load
from sitl.suite.loop.companion import LoopCompanion

_METRES_PER_DEGREE = 111_195.0  # of latitude, on the sphere that 0.6 m/s do not need better

# Computes until its time is over: a process that outlived the flight would disturb the next one.
_BURNER = """
import sys, time
end = time.monotonic() + float(sys.argv[1])
while time.monotonic() < end:
    sum(range(10_000))
"""


class GnssSpoofing:
    """Moves the simulated receiver's position away step by step (spoofing)."""

    def __init__(self, drag: Drag, link: GroundLink, home: Location, began_s: float) -> None:
        self._drag, self._link, self._began_s = drag, link, began_s
        self._cos = math.cos(math.radians(home.latitude_deg))

    def is_over(self, now_s: float) -> bool:
        """Whether the offset has its final value."""
        return now_s - self._began_s > self._drag.for_s + 1.0

    def step(self, now_s: float) -> None:
        """Set the offset that is due now."""
        seconds = min(now_s - self._began_s, self._drag.for_s)
        north, east = self._drag.north_m_s * seconds, self._drag.east_m_s * seconds
        self._link.set_parameter("SIM_GPS1_GLTCH_X", north / _METRES_PER_DEGREE)
        if self._drag.east_m_s:
            self._link.set_parameter("SIM_GPS1_GLTCH_Y", east / (_METRES_PER_DEGREE * self._cos))


class CpuLoad:
    """CPU load: confines the companion and busy processes to one processor."""

    def __init__(self, load: Load, companion: LoopCompanion) -> None:
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
        """End the load; harmless if it has ended."""
        for process in self._processes:
            process.kill()
            process.wait()
        self._companion.confine(self._all)
