"""The commands that the documentation names exist, with the options that it gives them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from sitl.__main__ import app
from tests.benchmarks.commands import COMMANDS, source
from tests.pages import PAGES, ROOT

_CODE = re.compile(r"```[^\n]*\n(.*?)```|`([^`]+)`", re.S)
_OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
_NAMED = re.compile(
    r"python -m (benchmarks\.[\w.]*\w|sitl(?: [a-z][\w-]*)?)|(make demo) ARGS"
    r"|(?:^|[ /(])(companion [a-z][\w-]*(?: [a-z]+)?)"
)
_PLACEHOLDERS = ("benchmarks.NAME", "sitl")
_QUOTED = re.compile(r'(?<!ARGS=)"[^"]*"')  # another program, or a value


def _companion() -> dict[str, set[str]]:
    """Options by command, of the page that is made from the program."""
    page = PAGES[ROOT / "docs/reference/cli.md"]
    parts = re.split(r"\n## ", page)[1:]
    return {part.splitlines()[0]: set(_OPTION.findall(part)) for part in parts}


def _sitl() -> dict[str, set[str]]:
    commands: dict[str, Any] = vars(get_command(app))["commands"]
    return {
        f"sitl {name}": {option for one in command.params for option in one.opts}
        for name, command in commands.items()
    }


def _benchmark(name: str) -> set[str]:
    path = source(name)
    files = path.parent.glob("*.py") if path.name == "__main__.py" else [path]
    return set(re.findall(r'"(--[a-z][\w-]*)"', "".join(file.read_text() for file in files)))


def _known() -> dict[str, set[str]]:
    known = {f"benchmarks.{name}": _benchmark(name) for name in COMMANDS} | _companion() | _sitl()
    known["make demo"] = known["sitl demo"]
    return known


KNOWN = _known()


def lines(text: str) -> Iterator[str]:
    """Each command line of a page: of its blocks, and what stands in the text as code."""
    for block, inline in _CODE.findall(text):
        code = block.replace("\\\n", " ") if block else inline.replace("\n", " ")
        for line in code.splitlines():
            yield from re.split(r"[;|&]", line.partition(" # ")[0])


def command_of(given: str) -> str:
    """ "companion map build" itself, "companion run" without its first argument; else as given."""
    shorter = given.rpartition(" ")[0]
    return shorter if given not in KNOWN and shorter in KNOWN else given


def strangers(line: str) -> list[str]:
    """Commands that are not there, and options that none of the line's commands has."""
    line = _QUOTED.sub("", line)
    named = [command_of(next(filter(None, found))) for found in _NAMED.findall(line)]
    groups = {name.rpartition(" ")[0] for name in KNOWN}  # "companion map"
    named = [name for name in named if name not in groups and name not in _PLACEHOLDERS]
    # In the middle of a line "companion" may be a word of a sentence.
    begins = re.compile(r"(?:^|/|\bsudo )companion .*|python -m .*|make demo.*")
    given = " ".join(begins.findall(line.strip()))
    unknown = [name for name in named if name not in KNOWN and name in given]
    known = [KNOWN[name] for name in named if name in KNOWN]
    options = _OPTION.findall(line) if known else []
    return list(dict.fromkeys(unknown)) or sorted(set(options) - set().union(*known, {"--help"}))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_their_options_exist(page: Path) -> None:
    found = {line.strip(): strangers(line) for line in lines(PAGES[page])}
    assert not {line: names for line, names in found.items() if names}
