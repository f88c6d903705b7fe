"""Command lines of the benchmarks: what makes no sense is said in one line, with exit code 2."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn


class _Help(argparse.RawDescriptionHelpFormatter):
    """Keeps the docstring's lines, and tells the defaults that say something."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        if isinstance(default, list | tuple):
            default = " ".join(str(item) for item in default)
        told = isinstance(default, str | int | float | Path) and not isinstance(default, bool)
        shown = told and default != argparse.SUPPRESS
        return f"{action.help} (default: {default})" if shown else action.help


class Parser(argparse.ArgumentParser):
    """A parser whose help is the benchmark's docstring, and whose errors are one line."""

    def __init__(self, description: str | None) -> None:
        path = Path(sys.argv[0])
        name = path.parent.name if path.stem == "__main__" else path.stem
        super().__init__(prog=name, description=description, formatter_class=_Help)

    def error(self, message: str) -> NoReturn:
        """The fault without the usage, which `--help` shows."""
        self.exit(2, f"{self.prog}: {message}\n")


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number of `low` to `high`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of {low} to {high}")
        return value

    return parse


def number(low: float, high: float) -> Callable[[str], float]:
    """A number of `low` to `high`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number of {low:g} to {high:g}")
        return value

    return parse


def existing(text: str) -> Path:
    """A file or folder that is there."""
    if not (path := Path(text)).exists():
        raise argparse.ArgumentTypeError(f"{text} does not exist")
    return path


def output(text: str) -> Path:
    """A file to write, in a folder that is there: known before the run and not after it."""
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is a folder, not a file to write")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{path.parent} is no folder to write to")
    return path
