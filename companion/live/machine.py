"""Load and temperature of this computer."""

from __future__ import annotations

import os
import time
from pathlib import Path

_ZONES = Path("/sys/class/thermal")
_HOT_READS_S = 5.0


class MachineLoad:
    """Measures the load of this process and of the machine."""

    def __init__(self) -> None:
        self._before = (time.monotonic(), self._used_s())
        self._temperature: tuple[float, float | None] = (-_HOT_READS_S, None)

    def read(self) -> dict[str, float | None]:
        """cpu_percent: of this process since the last call, 100 for one core; cores: their number;
        load: one-minute average; temperature_c: warmest zone, degrees Celsius, None if unknown.
        """
        now, used = time.monotonic(), self._used_s()
        elapsed = max(now - self._before[0], 1e-3)
        share = 100.0 * (used - self._before[1]) / elapsed
        self._before = (now, used)
        if now - self._temperature[0] >= _HOT_READS_S:
            self._temperature = (now, warmest_c())
        return {
            "cpu_percent": share,
            "cores": float(os.cpu_count() or 1),
            "load": os.getloadavg()[0],
            "temperature_c": self._temperature[1],
        }

    @staticmethod
    def _used_s() -> float:
        times = os.times()
        return times.user + times.system


def warmest_c() -> float | None:
    """Temperature of the warmest thermal zone, degrees Celsius; None if none can be read."""
    found = []
    for path in _ZONES.glob("thermal_zone*/temp"):
        try:
            found.append(int(path.read_text()) / 1000.0)
        except (OSError, ValueError):
            continue
    return max(found, default=None)
