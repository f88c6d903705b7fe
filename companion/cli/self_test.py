"""``companion self-test``: does the program compute rightly on this computer, and how fast."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rich.console import Console


def self_test_command() -> None:
    """Localize over a made map: compiles what a flight needs, and shows that it works here."""
    from companion.preflight.self_test import self_test

    console = Console()
    with tempfile.TemporaryDirectory(prefix="companion-self-test-") as folder:
        report = self_test(Path(folder), lambda line: console.print(f"{line} ..."))
    console.print(
        f"[green]self-test passed[/]: tracked to {report.error_m:.4f} m, found to "
        f"{report.found_error_m:.4f} m, {report.frame_ms:.0f} ms of processor a frame, the first "
        f"after {report.compiled_s:.0f} s"
    )
