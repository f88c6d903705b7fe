"""What a soak run is said to have found."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.bridge.soak_line import LineFault
from benchmarks.bridge.soak_report import FIX_HZ, ProcessSample, bounds

BEGUN = 100.0
COUNTERS = {"begun": BEGUN} | {
    f"{link}_{what}": 0 for link in ("fc", "ground") for what in ("handler_errors", "failures")
}
FAULT = LineFault("cut", BEGUN + 50.0, BEGUN + 60.0)


def flown(back_s: float) -> list[ProcessSample]:
    """240 s of which nothing is injected from the fault until `back_s`."""
    made, injected = [], 0
    for t in range(240):
        injected += 0 if 50 <= t < back_s else int(FIX_HZ)
        made.append(ProcessSample(float(t), 130.0, 9, 20, 5, injected))
    return made


def test_a_run_that_comes_back_and_does_not_grow_is_good() -> None:
    found = bounds(flown(63.0), [FAULT], COUNTERS)
    assert all(bound.good for bound in found)
    what, after, wanted = found[0].row
    assert what == "cut for 10 s (1): injecting again after, s"
    assert 2.0 <= float(after) <= 4.0
    assert wanted == "<= 45"


def test_what_never_comes_back_and_what_grows_stands_out() -> None:
    samples = [replace(s, rss_mib=130.0 + 0.1 * s.time_s, threads=9 + int(s.time_s > 200))
               for s in flown(300.0)]  # fmt: skip
    found = {b.what: b for b in bounds(samples, [FAULT], COUNTERS | {"fc_failures": 1})}
    bad = {what for what, bound in found.items() if not bound.good}
    assert bad == {
        "cut for 10 s (1): injecting again after, s", "growth of resident memory, MiB", "threads",
        "errors and failures of handlers",
    }  # fmt: skip
    assert found["threads"].row == ("threads", "**9 to 10**", "as many all the time")
    assert found["cut for 10 s (1): injecting again after, s"].found == "never"
