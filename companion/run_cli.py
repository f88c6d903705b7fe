"""``companion run``: the flight process."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer

from companion.config import load_config
from companion.console_log import console_log
from localizer.registration.devices import DeviceChoice
from localizer.render.select import Backend


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
    settings = load_config(config)
    given = {"renderer": renderer, "device": device}
    changes = {key: value for key, value in given.items() if value is not None}
    localizer = settings.localizer.model_copy(update=changes)
    settings = settings.model_copy(update={"localizer": localizer})
    from companion.app import Companion

    companion = Companion(settings)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: companion.interrupt())
    # The terminal may be a radio link that the aircraft flies away from.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with console_log(verbose):
        try:
            companion.run()
        finally:  # what is down needs no second order; the interpreter's own end would die of one
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
