"""What came of a soak test: its table, its verdict, its curves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bridge.soak_line import Fault

FIX_HZ = 20.0
WARM_UP_S = 120.0
RSS_BOUND_MIB = 8.0  # growth after the warm-up
RECOVERY_BOUND_S = 45.0  # a reboot includes the vehicle's own start


@dataclass(frozen=True)
class Sample:
    """One second of this process. rss_mib; descriptors; waiting: messages and bytes in queues."""

    time_s: float
    rss_mib: float
    threads: int
    descriptors: int
    waiting: int
    injected: int


def recovery_s(samples: list[Sample], fault: Fault, begun: float) -> float | None:
    """Seconds from a fault's end until injection flows again for 3 s; None if it never did."""
    after = [s for s in samples if s.time_s >= fault.ended - begun]
    for i in range(len(after) - 3):
        if after[i + 3].injected - after[i].injected > 2.0 * FIX_HZ:
            return after[i].time_s - (fault.ended - begun)
    return None


def judge(samples: list[Sample], faults: list[Fault], counters: dict[str, Any]) -> bool:
    """Print the table and whether every bound holds."""
    begun = counters["begun"]
    print("\n  minute   RSS MiB  threads  descriptors  waiting   injected")
    step = max(len(samples) // 15, 1)
    for s in samples[::step]:
        print(f"{s.time_s / 60:8.1f} {s.rss_mib:9.1f} {s.threads:8d} {s.descriptors:12d} "
              f"{s.waiting:8d} {s.injected:10d}")  # fmt: skip
    print("\n  fault        at min   for s   injecting again after s")
    slowest: float | None = 0.0  # None: one fault was never recovered from
    for fault in faults:
        recovery = recovery_s(samples, fault, begun)
        slowest = None if slowest is None or recovery is None else max(slowest, recovery)
        text = "never" if recovery is None else f"{recovery:.1f}"
        minute, length = (fault.begun - begun) / 60, fault.ended - fault.begun
        print(f"  {fault.kind:10} {minute:8.1f} {length:7.0f} {text:>14}")
    warm = [s for s in samples if s.time_s > min(WARM_UP_S, samples[-1].time_s / 4)]
    growth = float(
        np.mean([s.rss_mib for s in warm[-30:]]) - np.mean([s.rss_mib for s in warm[:30]])
    )
    threads = {s.threads for s in warm}
    checks = {
        f"RSS grew by {growth:+.1f} MiB (bound {RSS_BOUND_MIB:.0f})": growth <= RSS_BOUND_MIB,
        f"threads {min(threads)} to {max(threads)} (bound: equal)": len(threads) == 1,
        # A link that is between two transports has one descriptor less.
        f"descriptors at most {max(s.descriptors for s in warm)}, at first "
        f"{warm[0].descriptors} (bound: + 1)": (
            max(s.descriptors for s in warm) <= warm[0].descriptors + 1
        ),
        f"waiting at most {max(s.waiting for s in warm)} (bound 8192)": (
            max(s.waiting for s in warm) <= 8192
        ),
        f"handler errors {counters['fc_handler_errors']} + {counters['ground_handler_errors']}, "
        f"failures {counters['fc_failures']} + {counters['ground_failures']} (bound 0)": not any(
            counters[f"{link}_{what}"]
            for link in ("fc", "ground")
            for what in ("handler_errors", "failures")
        ),
        f"slowest return {'never' if slowest is None else f'{slowest:.0f} s'} "
        f"(bound {RECOVERY_BOUND_S:.0f})": slowest is not None and slowest <= RECOVERY_BOUND_S,
    }
    print()
    for text, good in checks.items():
        print(f"  {'ok   ' if good else 'WRONG'} {text}")
    keys = ("fc_messages", "fc_bad_bytes", "fc_bad_checksums", "fc_lost", "fc_opened",
            "fc_timeouts", "ground_bad_bytes", "bridge_reboots", "bridge_lost", "bridge_injected",
            "ignored_messages", "tlog_dropped", "reset_counter")  # fmt: skip
    print("  " + ", ".join(f"{key} {counters.get(key, 0)}" for key in keys))
    return all(checks.values())


def plot(samples: list[Sample], faults: list[Fault], begun: float, path: Path) -> None:
    """The curves over time, faults shaded."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(4, 1, figsize=(11, 8), sharex=True)
    minutes = [s.time_s / 60 for s in samples]
    rates = np.gradient([s.injected for s in samples], [s.time_s for s in samples])
    curves = (
        ("RSS, MiB", [s.rss_mib for s in samples]),
        ("threads, descriptors", [s.threads for s in samples]),
        ("waiting in queues", [s.waiting for s in samples]),
        ("injected, Hz", rates),
    )
    for axis, (label, values) in zip(axes, curves, strict=True):
        axis.plot(minutes, values, lw=1)
        axis.set_ylabel(label)
        for fault in faults:
            left, right = ((t - begun) / 60 for t in (fault.begun, fault.ended))
            axis.axvspan(left, right, color="tab:red", alpha=0.15)
    axes[1].plot(minutes, [s.descriptors for s in samples], lw=1)
    axes[0].set_ylim(0.0, 1.2 * max(s.rss_mib for s in samples))
    for fault in faults:
        axes[0].text((fault.begun - begun) / 60, 2, fault.kind, rotation=90, fontsize=7)
    axes[-1].set_xlabel("minutes")
    figure.tight_layout()
    figure.savefig(path, dpi=90)
