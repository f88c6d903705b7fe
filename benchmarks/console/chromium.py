"""A Chromium that stands behind a flight, and what it says of the pictures that it painted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.screens import BROWSER_OPTIONS, chromium

# Each picture's age once the frame that shows it was painted: the page tells of each that it drew.
NOTE_AGES = """() => {
  window.measured = [];
  addEventListener("console-picture", ({ detail }) => {
    window.measured.push([detail.exposure_utc_ms, detail.published_utc_ms, detail.made_utc_ms,
      detail.arrived_utc_ms, detail.shown_utc_ms]);
  });
}"""
_SHARES = ("flight", "console", "way", "browser")


def ages(shown: list[list[float]]) -> dict[str, float]:
    """Of pictures as `NOTE_AGES` notes them: age when painted, and what each part has of it, ms:
    flight until it gave the picture out with its pose, console until JPEG and edges were made, way
    to the page, browser until painted. All on one machine's clock.
    """
    times = np.array(shown, dtype=np.float64).reshape(-1, len(_SHARES) + 1)
    parts = {"age": times[:, -1] - times[:, 0]}
    parts |= dict(zip(_SHARES, np.diff(times, axis=1).T, strict=True))
    return {
        f"{name}_{'max' if q == 100 else f'p{q}'}_ms": float(
            np.percentile(part, q) if len(part) else np.nan
        )
        for name, part in parts.items()
        for q in (50, 95, 100)
    }


def opened_browser(driver: Any, nice: int) -> Any:
    """The system's, so much behind this process in priority. driver: of playwright."""
    before = descendants()
    browser = driver.chromium.launch(executable_path=chromium(), args=list(BROWSER_OPTIONS))
    _slow_down(before, nice)
    return browser


def used_s(process: int) -> float:
    """Processor time of a process, all threads; `proc(5)`: utime and stime, in clock ticks."""
    after_name = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


def browser_used_s() -> dict[str, float]:
    """Processor time of the browsers that this process opened, until now: of the pages
    ("renderer"), of what draws their map and the screen ("gpu-process"), of the "rest".
    """
    used = {"renderer": 0.0, "gpu-process": 0.0, "rest": 0.0}
    for pid in descendants():
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b" ", b"\0").split(b"\0")
            if b"chrom" not in words[0]:
                continue
            taken_s = used_s(pid)
        except OSError:  # it ended meanwhile
            continue
        kind = next((w[7:].decode() for w in words if w.startswith(b"--type=")), "rest")
        used[kind if kind in used else "rest"] += taken_s
    return used


def descendants() -> set[int]:
    """This process, the processes that it started, and theirs."""
    found: set[int] = set()
    waiting = [os.getpid()]
    while waiting:
        pid = waiting.pop()
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += [int(p) for p in (task / "children").read_text().split()]
        except OSError:  # it ended meanwhile
            continue
        found.add(pid)
    return found


def _slow_down(before: set[int], nice: int) -> None:
    """The browser stands behind the flight by so much: what it starts later inherits that."""
    for pid in descendants() - before:
        try:
            # What else began meanwhile, as the companion of a flight, is no part of it.
            if b"chrom" not in Path(f"/proc/{pid}/cmdline").read_bytes():
                continue
            for task in Path(f"/proc/{pid}/task").iterdir():
                number = int(task.name)
                now = os.getpriority(os.PRIO_PROCESS, number)
                os.setpriority(os.PRIO_PROCESS, number, min(now + nice, 19))
        except OSError:
            continue
