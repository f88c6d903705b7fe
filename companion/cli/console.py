"""``companion console``: the operator's page in its own process."""

from __future__ import annotations

import os
import sys
import threading
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.output import tell
from companion.config import load_config
from companion.errors import ConfigError
from companion.live.config import ConsoleConfig
from companion.settings_file import SettingsError, validated
from companion.terminal.console_log import console_log

if TYPE_CHECKING:
    from companion.console.server import ConsoleSite

_NICE = 10  # below what flies, which starts it
_LOWEST = 19


def console_command(
    config: Annotated[Path, typer.Argument(help="deployment YAML")],
    listen: Annotated[
        str | None, typer.Option(help="address:port instead of console.listen")
    ] = None,
    lifeline: Annotated[
        bool, typer.Option("--lifeline", hidden=True, help="end with standard input")
    ] = False,
) -> None:
    """Serve the operator's page, with or without a flight."""
    settings = load_config(config)
    given = settings.console or ConsoleConfig()
    # The flight is met by the deployment's own address, whatever this page listens on.
    meeting = given.listen
    if listen is not None:
        given = listening("--listen", listen, given)
    os.setpriority(os.PRIO_PROCESS, 0, min(os.getpriority(os.PRIO_PROCESS, 0) + _NICE, _LOWEST))
    if lifeline:
        threading.Thread(target=_end_with_input, name="lifeline", daemon=True).start()
    require_extra()
    from companion.console.records import Records
    from companion.console.security import read_token
    from companion.console.server import ConsoleSite
    from companion.console.source import FlightSource
    from companion.live.protocol import socket_path

    record = None if settings.record is None else settings.record.folder
    source = FlightSource(socket_path(settings.map, record, meeting))
    records = Records(None if record is None else record.parent)
    token = read_token(given.token_file)
    serve(ConsoleSite(given, source, settings.map, records, config.absolute(), token))


def listening(option: str, listen: str, given: ConsoleConfig | None = None) -> ConsoleConfig:
    """The settings with another address:port; `ConfigError` names the option that gave it."""
    settings = {} if given is None else given.model_dump()
    try:
        return validated(ConsoleConfig, settings | {"listen": listen})
    except SettingsError as error:
        raise ConfigError(f"{option} {listen}: {str(error).strip()}") from error


def require_extra() -> None:
    """`ConfigError` if the packages of the extra `console` are not installed."""
    try:
        for name in ("starlette", "uvicorn", "websockets"):
            import_module(name)
    except ImportError as error:
        raise ConfigError(f"install pilot-companion[console] for the console: {error}") from error


def serve(site: ConsoleSite) -> None:
    """Serve the page until interrupted. Prints the address once the page can be opened."""
    from companion.console.serving import Server

    server = Server(site, lambda: tell(f"console: [green]{site.config.url}[/]"))
    with console_log(verbose=False):
        server.run()


def _end_with_input() -> None:
    """End with the standard input: the flight process that started this one has ended."""
    while sys.stdin.buffer.read(1):
        pass
    os._exit(0)
