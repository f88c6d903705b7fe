"""``companion run``: the flight process."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.interrupts import end_at_once
from companion.config import load_config
from companion.terminal.console_log import console_log
from localizer.registration.devices import DeviceChoice
from localizer.render.select import RendererName

# Records (positions, pictures, the deployment's settings) are for their owner and group: files
# 0640, folders 0750.
_UMASK = 0o027
ENDING = (signal.SIGINT, signal.SIGTERM)


def run_command(
    config: Annotated[Path, typer.Argument(help="deployment YAML, see configs/")],
    renderer: Annotated[
        RendererName | None, typer.Option(help="instead of the configuration's localizer.renderer")
    ] = None,
    device: Annotated[
        DeviceChoice | None, typer.Option(help="instead of the configuration's localizer.device")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log more")] = False,
) -> None:
    """Localize the camera feed and inject positions until interrupted."""
    # Whatever is imported or read until there is something to put away.
    for number in ENDING:
        signal.signal(number, end_at_once)
    settings = load_config(config)
    os.umask(_UMASK)
    given = {"renderer": renderer, "device": device}
    changes = {key: value for key, value in given.items() if value is not None}
    localizer = settings.localizer.model_copy(update=changes)
    settings = settings.model_copy(update={"localizer": localizer})
    from companion.flight.app import Companion

    companion = Companion(settings)

    def interrupt(*_: object) -> None:
        if not companion.stop():  # the way up takes seconds, and is not waited for
            companion.discard_record()
            end_at_once()

    for number in ENDING:
        signal.signal(number, interrupt)
    # The terminal may be a radio link that the aircraft flies away from.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with console_log(verbose):
        try:
            companion.run()
        finally:  # what is down needs no second order; the interpreter's own end would die of one
            for number in ENDING:
                signal.signal(number, signal.SIG_IGN)
