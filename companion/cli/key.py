"""``companion key``: make and install the key for MAVLink signing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from companion.cli.output import tell
from companion.errors import ConfigError
from companion.terminal.steps import show_work
from companion.writing import writing
from mavlink_bridge.errors import EndpointError
from mavlink_bridge.link.signing import create_key
from mavlink_bridge.link.transport import Endpoint


def key_command(
    file: Annotated[Path, typer.Argument(help="key file to make, mode 0600")],
    install: Annotated[
        str | None,
        typer.Option(help="connection of the disarmed flight controller"),
    ] = None,
) -> None:
    """Make a signing key; --install sends it (or the one in FILE) to the autopilot."""
    if install is not None:
        try:  # before a key is made that cannot be installed
            Endpoint.parse(install)
        except EndpointError as error:
            raise ConfigError(f"--install {install}: {error}") from error
    if not file.exists():
        with writing(file):
            create_key(file)
        tell(f"{file}: made; keep a copy, and keep it from others")
    elif install is None:
        raise ConfigError(f"{file}: is there already and not overwritten; give another name")
    if install is not None:
        from mavlink_bridge.preflight.client import install_key

        tell("the key goes over this connection in clear: use a cable")
        with show_work(Console(stderr=True), f"waiting for the flight controller at {install}"):
            installed = install_key(install, file)
        if installed:
            tell("installed: the autopilot's heartbeat is signed with it")
        else:
            tell(
                "[yellow]sent, not confirmed[/]: no signed heartbeat came. ArduPilot's USB port "
                "stays unsigned (check on the companion's port); or another key is in force"
            )
    tell(f"deployment: bridge.signing: {{key_file: {file}}}")
    tell(
        "ground stations need the same key before they connect: docs/reference/messages.md, Signing"
    )
