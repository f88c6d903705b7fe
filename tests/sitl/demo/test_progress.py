"""Progress in a log: a line per phase, and one every ten seconds of a long one."""

from __future__ import annotations

import io

from rich.console import Console

from sitl.demo.progress import LogProgress, shown_progress


def test_a_log_gets_a_line_per_phase_and_every_ten_seconds() -> None:
    out, now = io.StringIO(), [100.0]
    show = LogProgress(Console(file=out, width=80), lambda: now[0])
    for second in range(46):
        now[0] = 100.0 + second
        show("taking off" if second < 15 else "GNSS denied", second / 45)
    lines = out.getvalue().splitlines()
    assert lines[0] == "   0 s   0 % taking off"
    assert [int(line.split()[0]) for line in lines] == [0, 10, 15, 25, 35, 45]
    assert lines[-1] == "  45 s 100 % GNSS denied"


def test_what_is_no_terminal_gets_lines() -> None:
    out = io.StringIO()
    with shown_progress(Console(file=out, width=80)) as progress:
        progress("starting the vehicle", 0.0)
    assert "starting the vehicle" in out.getvalue()
    with shown_progress(Console(file=io.StringIO(), force_terminal=True, width=80)) as progress:
        progress("starting the vehicle", 0.0)
    assert not isinstance(progress, LogProgress)
