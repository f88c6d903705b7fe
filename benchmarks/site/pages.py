"""The reference pages that only the site has, made from the program itself."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperGroup
from typer.models import ArgumentInfo, OptionInfo

from benchmarks.site.api import api_page
from companion.cli.commands import app

_CLI = """# Command line

Every command of `companion` with its arguments and options, for whoever runs it.
`companion COMMAND --help` prints the same.

Names in capitals are arguments, given in the order of the table; `...` means one or more. Options
take an integer N, a number X, TEXT, a PATH or one of the listed words; an option without these is a
switch, off by default (with a `--no-` form: on). An empty default: not set.
The last words of a meaning, such as 1 to 170, are the allowed range.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | `doctor`: advice; `localize`: nothing localized; `map check`: a bad property; `map fetch`, \
`map verify`: damage; `plan`: a failing leg; `replay`: a difference; `shadow-check`: not ready; \
`try`: vision does not work, or there is no map |
| 2 | wrong usage, a named error, or `doctor`: not fit to fly |
| 130 | interrupted (a flying `run` ends with 0) |
"""

_KINDS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}


@dataclass(frozen=True)
class _Parameter:
    """One argument or option, as its function declares it."""

    name: str
    kind: Any
    info: ArgumentInfo | OptionInfo
    default: Any

    @property
    def is_argument(self) -> bool:
        """Whether it is given by its place."""
        return isinstance(self.info, ArgumentInfo)

    @property
    def words(self) -> str:
        """What is written on the command line."""
        if self.is_argument:
            return self.name.upper() + ("..." if get_origin(self.kind) is list else "")
        # In an annotation the first name stands where the default of older typers stood.
        first = [self.info.default] if isinstance(self.info.default, str) else []
        named = ", ".join([*first, *(self.info.param_decls or ())])
        plain = "--" + self.name.replace("_", "-")
        return named or (f"{plain}, --no-{plain[2:]}" if self.default is True else plain)

    @property
    def is_required(self) -> bool:
        """Whether the command ends without it."""
        return self.default is inspect.Parameter.empty


def built_pages() -> dict[str, str]:
    """Path below docs/ to the text of each page that is written when the site is built."""
    return {"reference/cli.md": _command_page(), "reference/api.md": api_page()}


def _command_page() -> str:
    lines = [_CLI]
    for name, function in _commands("companion", typer.main.get_group(app)):
        parameters = list(_parameters(function))
        help_text = _sentence((function.__doc__ or "").split("\n\n")[0])
        lines += [f"## {name}\n", help_text, ""]
        if parameters:
            lines += ["| argument, option | default | meaning |", "|---|---|---|"]
            lines += [*map(_row, parameters), ""]
    return "\n".join(lines)


def _commands(name: str, group: TyperGroup) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Every command's function, with the words that call it."""
    for word, command in group.commands.items():
        if isinstance(command, TyperGroup):
            yield from _commands(f"{name} {word}", command)
        elif command.callback is not None:
            yield f"{name} {word}", inspect.unwrap(command.callback)


def _parameters(function: Callable[..., Any]) -> Iterator[_Parameter]:
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if get_origin(hints.get(name)) is not Annotated:
            continue
        kind, *notes = get_args(hints[name])
        info = next(n for n in notes if isinstance(n, ArgumentInfo | OptionInfo))
        if not info.hidden:
            yield _Parameter(name, kind, info, parameter.default)


def _row(parameter: _Parameter) -> str:
    kind = "" if parameter.is_argument else _kind(parameter.kind)
    name = f"`{parameter.words}`{kind and ' ' + kind}"
    meaning = "; ".join(filter(None, (_sentence(parameter.info.help), _bounds(parameter.info))))
    return f"| {name} | {_default(parameter)} | {meaning} |"


def _kind(kind: Any) -> str:
    """What an option takes; nothing for a switch."""
    if get_origin(kind) in (Union, UnionType):
        kind = next(part for part in get_args(kind) if part is not NoneType)
    if get_origin(kind) is list:
        return f"{_kind(get_args(kind)[0])} (again for more)"
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ", ".join(f"`{choice.value}`" for choice in kind)
    return _KINDS.get(kind, "")


def _bounds(info: ArgumentInfo | OptionInfo) -> str:
    if info.min is not None and info.max is not None:
        return f"{info.min:g} to {info.max:g}"
    if info.max is not None:
        return f"at most {info.max:g}"
    return f"at least {info.min:g}" if info.min is not None else ""


def _default(parameter: _Parameter) -> str:
    value = parameter.default.value if isinstance(parameter.default, Enum) else parameter.default
    if parameter.is_required:
        return "required"
    return "" if value is None or isinstance(value, bool) or value in ("", []) else f"`{value}`"


def _sentence(text: str | None) -> str:
    """On one line, as Markdown takes it."""
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;")
