"""``companion run``: the flight process."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import Annotated

import typer
from rich.logging import RichHandler

from companion.config import load_config
from localizer.registration.devices import DeviceChoice
from localizer.render.select import Backend

OURS = ("companion", "localizer", "mavlink_bridge")


def log_to_console(verbose: bool) -> None:
    """Log to the console; `verbose` holds for our packages, because numba's own log is endless."""
    logging.basicConfig(
        level=logging.INFO, format="%(message)s", handlers=[RichHandler(show_path=False)]
    )
    for name in OURS:
        logging.getLogger(name).setLevel(logging.DEBUG if verbose else logging.NOTSET)


def run_command(
    config: Annotated[Path, typer.Argument(help="deployment YAML, see configs/")],
    renderer: Annotated[
        Backend | None, typer.Option(help="instead of the configuration's localizer.renderer")
    ] = None,
    device: Annotated[
        DeviceChoice | None, typer.Option(help="instead of the configuration's localizer.device")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log more")] = False,
) -> None:
    """Localize the camera feed and inject positions until interrupted."""
    log_to_console(verbose)
    settings = load_config(config)
    given = {"renderer": renderer, "device": device}
    changes = {key: value for key, value in given.items() if value is not None}
    localizer = settings.localizer.model_copy(update=changes)
    settings = settings.model_copy(update={"localizer": localizer})
    from companion.app import Companion

    companion = Companion(settings)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: companion.interrupt())
    companion.run()
