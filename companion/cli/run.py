"""``companion run``: the flight process."""

from __future__ import annotations

import os
import signal
import sys
from itertools import count
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.output import end_at_once
from companion.config import CompanionConfig
from companion.supervision.processes import keep_settings, settings_of
from companion.terminal.console_log import console_log
from companion.terminal.console_process import running_console
from localizer.registration.devices import DeviceChoice
from localizer.render.select import RendererName
from mavlink_bridge.alerts.alert import Alert

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
    supervised: Annotated[
        bool, typer.Option(help="restart the process if it dies, and report it")
    ] = False,
    standby: Annotated[bool, typer.Option(hidden=True)] = False,
    pulse: Annotated[int | None, typer.Option(hidden=True, min=3)] = None,
    restart: Annotated[bool, typer.Option("--restart", "--again", hidden=True)] = False,
    kept: Annotated[int | None, typer.Option(hidden=True, min=3)] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log more")] = False,
) -> None:
    """Localize the camera feed and inject positions until interrupted."""
    # Whatever is imported or read until there is something to put away.
    for number in ENDING:
        signal.signal(number, end_at_once)
    if pulse is not None:
        os.setpgrp()  # see `FlightProcess`
    settings, lost = settings_of(config, kept)
    os.umask(_UMASK)
    if supervised:
        arguments = [str(config), *(["--verbose"] if verbose else [])]
        arguments += [f"--renderer={renderer}"] if renderer is not None else []
        arguments += [f"--device={device}"] if device is not None else []
        with console_log(verbose):
            raise typer.Exit(_supervise(settings, arguments))
    given = {"renderer": renderer, "device": device}
    changes = {key: value for key, value in given.items() if value is not None}
    localizer = settings.localizer.model_copy(update=changes)
    settings = settings.model_copy(update={"localizer": localizer})
    from companion.flight.app import released_companion

    companion = released_companion(
        settings, standby=standby, pulse=pulse, restart=restart, lost_settings=lost
    )
    if companion is None:
        return

    def interrupt(*_: object) -> None:
        if not companion.stop():  # the way up takes seconds, and is not waited for
            companion.discard_record()
            end_at_once()

    for number in ENDING:
        signal.signal(number, interrupt)
    # The terminal may be a radio link that the aircraft flies away from.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with console_log(verbose), running_console(config, settings.console):
        try:
            companion.run()
        finally:  # what is down needs no second order; the interpreter's own end would die of one
            for number in ENDING:
                signal.signal(number, signal.SIG_IGN)


def _supervise(settings: CompanionConfig, arguments: list[str]) -> int:
    """Run the supervisor; returns the exit code of the last flight process."""
    from companion.supervision.processes import FlightProcess, ServiceManager
    from companion.supervision.supervisor import Supervisor, mark_dead
    from mavlink_bridge.vehicle.crash_notifier import report_without_bridge

    command = [sys.executable, "-m", "companion", "run", *arguments]
    record = settings.record

    def tell(alert: Alert) -> None:
        report_without_bridge(settings.bridge, alert)

    begun, kept = count(), keep_settings(settings)

    def spawn(standby: bool) -> FlightProcess:
        if not next(begun):
            return FlightProcess(command, standby=standby)
        restart = [*command, f"--kept={kept}", "--restart"]
        return FlightProcess(restart, standby=standby, hands_on=(kept,))

    supervisor = Supervisor(
        spawn,
        tell,
        lambda pid, text: mark_dead(record.folder, pid, text) if record is not None else None,
        manager=ServiceManager.of(os.environ),
    )
    for number in ENDING:
        signal.signal(number, lambda received, _: supervisor.stop(received))
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    return supervisor.run()
