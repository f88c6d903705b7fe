"""What came of a soak test: its table, its verdict, its curves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bridge.soak_line import LineFault

FIX_HZ = 20.0
WARM_UP_S = 120.0
RSS_BOUND_MIB = 8.0  # growth after the warm-up
RECOVERY_BOUND_S = 45.0  # a reboot includes the vehicle's own start


@dataclass(frozen=True)
class ProcessSample:
    """One second of this process. rss_mib; descriptors; waiting: messages and bytes in queues."""

    time_s: float
    rss_mib: float
    threads: int
    descriptors: int
    waiting: int
    injected: int


def recovery_s(samples: list[ProcessSample], fault: LineFault, begun: float) -> float | None:
    """Seconds from a fault's end until injection flows again for 3 s; None if it never did."""
    after = [s for s in samples if s.time_s >= fault.ended - begun]
    for i in range(len(after) - 3):
        if after[i + 3].injected - after[i].injected > 2.0 * FIX_HZ:
            return after[i].time_s - (fault.ended - begun)
    return None


@dataclass(frozen=True)
class Bound:
    """One thing that must hold: what, as it was found, as it is wanted."""

    what: str
    found: str
    wanted: str
    good: bool

    @property
    def row(self) -> tuple[str, str, str]:
        """As `COLUMNS` has it; what is missed stands out."""
        return self.what, self.found if self.good else f"**{self.found}**", self.wanted


COLUMNS = ("figure", "found", "wanted")


def bounds(
    samples: list[ProcessSample], faults: list[LineFault], counters: dict[str, Any]
) -> list[Bound]:
    """Every kind of fault with the seconds until injection was back, then what must not grow."""
    found = [
        _returns(kind, [f for f in faults if f.kind == kind], samples, counters["begun"])
        for kind in dict.fromkeys(f.kind for f in faults)
    ]
    warm = [s for s in samples if s.time_s > min(WARM_UP_S, samples[-1].time_s / 4)]
    growth = float(
        np.mean([s.rss_mib for s in warm[-30:]]) - np.mean([s.rss_mib for s in warm[:30]])
    )
    threads = sorted({s.threads for s in warm})
    descriptors, waiting = max(s.descriptors for s in warm), max(s.waiting for s in warm)
    errors = [
        counters[f"{link}_{what}"]
        for what in ("handler_errors", "failures")
        for link in ("fc", "ground")
    ]
    return [
        *found,
        Bound("growth of resident memory, MiB", f"{growth:+.1f}", f"<= {RSS_BOUND_MIB:.0f}",
              growth <= RSS_BOUND_MIB),
        Bound("threads", " to ".join(map(str, dict.fromkeys((threads[0], threads[-1])))),
              "as many all the time", len(threads) == 1),
        # A link that is between two transports has one descriptor less.
        Bound("descriptors, at most", str(descriptors), f"<= {warm[0].descriptors + 1}",
              descriptors <= warm[0].descriptors + 1),
        Bound("messages and bytes waiting, at most", str(waiting), "<= 8192", waiting <= 8192),
        Bound("errors and failures of handlers", str(sum(errors)), "0", not any(errors)),
    ]  # fmt: skip


def _returns(
    kind: str, alike: list[LineFault], samples: list[ProcessSample], begun: float
) -> Bound:
    seconds = [recovery_s(samples, fault, begun) for fault in alike]
    # A reboot's length is the vehicle's own.
    lasted = " and ".join(dict.fromkeys(f"{f.ended - f.begun:.0f} s" for f in alike))
    told = ", ".join("never" if s is None else f"{s:.1f}" for s in seconds)
    good = all(s is not None and s <= RECOVERY_BOUND_S for s in seconds)
    what = f"{kind} for {lasted} ({len(alike)}): injecting again after, s"
    return Bound(what, told, f"<= {RECOVERY_BOUND_S:.0f}", good)


def judge(
    samples: list[ProcessSample], faults: list[LineFault], counters: dict[str, Any]
) -> list[Bound]:
    """What must hold, printed with the course of the run and its counters."""
    print("\n  minute   RSS MiB  threads  descriptors  waiting   injected")
    step = max(len(samples) // 15, 1)
    for s in samples[::step]:
        print(f"{s.time_s / 60:8.1f} {s.rss_mib:9.1f} {s.threads:8d} {s.descriptors:12d} "
              f"{s.waiting:8d} {s.injected:10d}")  # fmt: skip
    found = bounds(samples, faults, counters)
    print()
    for bound in found:
        print(
            f"  {'ok   ' if bound.good else 'WRONG'} {bound.what}: {bound.found} ({bound.wanted})"
        )
    print("  " + ", ".join(f"{key} {value}" for key, value in told(counters).items()))
    return found


def told(counters: dict[str, Any]) -> dict[str, int]:
    """The counters that say how much went through, and how much of it was damage."""
    keys = ("fc_messages", "fc_bad_bytes", "fc_bad_checksums", "fc_lost", "fc_opened",
            "fc_timeouts", "ground_bad_bytes", "bridge_reboots", "bridge_lost", "bridge_injected",
            "ignored_messages", "tlog_dropped", "reset_counter")  # fmt: skip
    return {key: int(counters.get(key) or 0) for key in keys}


def plot(samples: list[ProcessSample], faults: list[LineFault], begun: float, path: Path) -> None:
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
