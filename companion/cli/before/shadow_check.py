"""``companion shadow-check``: run bridge and integrity monitor on a recorded flight."""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.before.shared_options import FieldOfView, FootageCamera, MountPitch
from companion.cli.output import show_table, tell, tell_notes
from companion.terminal.steps import COMPILES, show_count
from companion.writing import result_file, write_result

if TYPE_CHECKING:
    from companion.config import CompanionConfig
    from companion.offline.shadow_check import ShadowCheck
    from companion.recorded.flight import RecordedFlight

_WARNING = 4  # MAV_SEVERITY


def shadow_check_command(
    log: Annotated[Path, typer.Argument(help="the flight's .bin, .tlog or .ulg")],
    video: Annotated[Path, typer.Option(help="video or folder of photos of the same flight")],
    map_cache: Annotated[
        Path, typer.Option("--map", help="tile cache made by `companion map build`")
    ],
    config: Annotated[
        Path | None, typer.Option(help="deployment file; default: made from the footage")
    ] = None,
    camera: FootageCamera = None,
    fov: FieldOfView = None,
    mount_pitch: MountPitch = -90.0,
    rate_hz: Annotated[float, typer.Option(min=0.1, max=60, help="most images per second")] = 5.0,
    report: Annotated[Path | None, typer.Option("--json", help="file for all figures")] = None,
) -> None:
    """Play a recorded flight through bridge and integrity monitor, as in shadow mode.

    Exit code 0: ready; 1: not ready.
    """
    from companion.config import load_config
    from companion.offline.shadow_check import shadow_check
    from companion.recorded.footage import FootageOptions, read_footage
    from localizer.map.cache.cache import TileCache

    TileCache.open(map_cache)  # what is missing is said before anything is computed
    if report is not None:
        result_file(report, "--json", (".json",), log, video, config, camera)
    console = Console(stderr=True)
    with tempfile.TemporaryDirectory(prefix="shadow-check-") as work:
        told = None if config is None else load_config(config)
        if told is not None and camera is None and fov is None:
            camera = Path(work) / "camera.json"
            model = told.camera.model.camera()
            camera.write_text(json.dumps(model.to_dict()), encoding="utf-8")
        options = FootageOptions(Path(work), 60, None, log, camera, fov, mount_pitch)
        with show_count(console, "reading footage") as count:
            flight = read_footage(video, options, count)
        if told is None:
            deployment = _deployment(flight, map_cache)
        else:
            deployment = told.model_copy(update={"map": map_cache})
        playing = show_count(console, "playing the flight, s", begins=COMPILES)
        with playing as count, _without_warnings("mavlink_bridge.status"):
            found = shadow_check(
                flight, video, deployment, rate_hz, lambda s, total: count(round(s), round(total))
            )
    if report is not None:
        text = json.dumps(asdict(found) | {"go": found.go}, indent=1)
        write_result(report, text, "--json")
    _show(found)
    raise typer.Exit(0 if found.go else 1)


@contextmanager
def _without_warnings(name: str) -> Iterator[None]:
    """Suppress a logger's warnings, because the table holds what the operator is told."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _deployment(flight: RecordedFlight, map_cache: Path) -> CompanionConfig:
    import numpy as np

    from companion.config import parse_config
    from companion.trial.deployment import footage_settings

    pitch_deg = None if flight.log is None else flight.log.fixed_pitch_deg
    mount_deg = np.array([0.0, pitch_deg or 0.0, 0.0])
    fixed = pitch_deg is not None
    settings = footage_settings(map_cache, flight.camera.camera, mount_deg, fixed=fixed)
    return parse_config(settings, flight.name)


def _show(found: ShadowCheck) -> None:
    tell_notes(found.notes)
    lines = [line for line in found.lines if line.severity <= _WARNING]
    if lines:
        rows = [(f"{line.at_s:.0f}", escape(line.text)) for line in lines]
        show_table(("at, s", "the operator would have read"), rows)
    held = ", ".join(f"{name} {s:.0f} s" for name, s in found.held_s.items()) or "never"
    begun = "never" if found.first_go_s is None else f"from {found.first_go_s:.0f} s on"
    for text in (
        f"{found.frames} images in {found.seconds:.0f} s: {found.localized} localized, "
        f"{found.accepted} accepted; {found.passed} of {found.judged} fixes passed the monitor",
        f"output held: {held}",
        f"the shadow score was a go for {found.go_s:.0f} s, {begun}",
    ):
        tell(text)
    style = "bold green" if found.go else "bold red"
    tell(f"shadow verdict: {escape(found.score.line())}", style)
