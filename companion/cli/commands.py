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
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from companion.cli.before.calibrate import app as calibrate_app
from companion.cli.before.init import init_command
from companion.cli.before.plan import plan_command
from companion.cli.before.shadow_check import shadow_check_command
from companion.cli.before.try_footage import try_command
from companion.cli.console import console_command
from companion.cli.convert import convert_command
from companion.cli.doctor import doctor_command, self_test_command
from companion.cli.evaluate import evaluate_command
from companion.cli.export import export_command, klv_command
from companion.cli.interrupts import INTERRUPTED
from companion.cli.key import key_command
from companion.cli.localize import localize_command
from companion.cli.map import app as map_app
from companion.cli.output import tell
from companion.cli.replay import replay_command
from companion.cli.report import report_command
from companion.cli.run import run_command
from companion.cli.world import app as world_app
from companion.errors import CompanionError, ConfigError
from companion.versions import versions
from localizer.errors import LocalizerError
from mavlink_bridge.errors import BridgeError


class _Commands(TyperGroup):
    """Refuses options that are no finite numbers: the ranges of options let `nan` pass."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        for option, value in itertools.pairwise(
            arg for whole in args for arg in whole.split("=", 1)
        ):
            if option.startswith("--") and re.fullmatch(r"(?i)[+-]?(nan|inf(inity)?)", value):
                raise ConfigError(f"{option} {value}: give a finite number")
        return super().resolve_command(ctx, args)


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


app.command("try")(try_command)
app.command("shadow-check")(shadow_check_command)
app.command("run")(run_command)
app.command("init")(init_command)
app.command("plan")(plan_command)
app.command("eval")(evaluate_command)
app.command("localize")(localize_command)
app.command("convert")(convert_command)
app.command("replay")(replay_command)
app.command("report")(report_command)
app.command("export")(export_command)
app.command("console")(console_command)
app.command("klv")(klv_command)
app.command("doctor")(doctor_command)
app.command("key")(key_command)
app.command("self-test")(self_test_command)
app.add_typer(
    calibrate_app, name="calibrate", help="Camera, mounting and times, from a flight or a board."
)
app.add_typer(map_app, name="map", help="Build and inspect tile caches.")
app.add_typer(world_app, name="world", help="Generated worlds for tests and demos.")


def main() -> None:
    """Entry point: named errors become one clear line and exit code 2."""
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the imports are over
        app()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    # OSError: of a disk or a folder, which the program cannot help and which names its path.
    except (CompanionError, LocalizerError, BridgeError, OSError) as error:
        # Escaped: a path or a value in the text may look like the console's markup.
        name, text = type(error).__name__, escape(str(error))
        tell(f"[bold red]{name}[/]: {text}", err=True)
        sys.exit(2)
