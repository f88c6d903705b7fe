"""The command line: ``companion try | shadow-check | init | calibrate | run | plan | eval |
localize | convert | replay | report | export | klv | console | map | world | doctor | key |
self-test``.

Exit codes: 0 done; 1 `doctor` found advice, `plan` a leg on which vision will not do, `replay`
differs, `localize` localized nothing, `try` or `shadow-check` found that vision does not work
there, `map check` found a bad property, or `map fetch` or `map verify` found damage; 2 wrong usage,
a named error, or `doctor` found the vehicle not fit to fly; 130 interrupted (`run` that was flying
ends with 0).
"""

from __future__ import annotations

import itertools
import re
import signal
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from companion.cli.output import INTERRUPTED, end_at_once, tell
from companion.errors import CompanionError, ConfigError
from companion.versions import versions
from localizer.errors import LocalizerError
from mavlink_bridge.errors import BridgeError

# Command to module and name below companion.cli.
_COMMANDS = {
    "try": "before.try_footage:try_command",
    "shadow-check": "before.shadow_check:shadow_check_command",
    "run": "run:run_command",
    "init": "before.init:init_command",
    "plan": "before.plan:plan_command",
    "eval": "evaluate:evaluate_command",
    "localize": "localize:localize_command",
    "convert": "convert:convert_command",
    "replay": "replay:replay_command",
    "report": "report:report_command",
    "export": "export:export_command",
    "console": "console:console_command",
    "klv": "export:klv_command",
    "doctor": "doctor:doctor_command",
    "key": "key:key_command",
    "self-test": "doctor:self_test_command",
    "calibrate": "before.calibrate:app",
    "map": "map:app",
    "world": "world:app",
}


class _ImportedCommands(Mapping[str, Any]):
    """Imports a command when it is asked for: the imports of all take a second more."""

    def __getitem__(self, name: str) -> Any:
        module, attribute = _COMMANDS[name].split(":")
        found = getattr(import_module(f"companion.cli.{module}"), attribute)
        if isinstance(found, typer.Typer):
            group = typer.main.get_group(found)
            group.name = name
            return group
        alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        alone.command(name)(found)
        return typer.main.get_command(alone)

    def get(self, name: str, default: Any = None) -> Any:
        """A KeyError of the import is not "no such command"."""
        return self[name] if name in _COMMANDS else default

    def __iter__(self) -> Iterator[str]:
        return iter(_COMMANDS)

    def __len__(self) -> int:
        return len(_COMMANDS)


class _Commands(TyperGroup):
    """Refuses options that are no finite numbers: the ranges of options let `nan` pass."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes | {"commands": _ImportedCommands()})

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        for option, value in itertools.pairwise(
            arg for whole in args for arg in whole.split("=", 1)
        ):
            if option.startswith("--") and re.fullmatch(r"(?i)[+-]?(nan|inf(inity)?)", value):
                raise ConfigError(f"{option} {value}: give a finite number")
        found = super().resolve_command(ctx, args)
        if signal.getsignal(signal.SIGINT) is end_at_once:  # the command is imported
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return found


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="GNSS-denied navigation from video and a geo-referenced 3D map.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"companion {versions().get('pilot-companion', 'not installed')}")
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="print the version and exit"
        ),
    ] = False,
) -> None:
    """Options of every command."""


def main() -> None:
    """Entry point: named errors become one clear line and exit code 2."""
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    # OSError: of a disk or a folder, which the program cannot help and which names its path.
    except (CompanionError, LocalizerError, BridgeError, OSError) as error:
        # Escaped: a path or a value in the text may look like the console's markup.
        name, text = type(error).__name__, escape(str(error))
        tell(f"[bold red]{name}[/]: {text}", err=True)
        sys.exit(2)
