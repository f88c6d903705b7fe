"""Other people's code for browsers, kept in the package with its licences."""

from __future__ import annotations

from importlib import resources


def vendored(name: str) -> str:
    """The text of a file of companion/console/static/vendor."""
    folder = resources.files("companion") / "console" / "static" / "vendor"
    return (folder / name).read_text(encoding="utf-8")


def licence_of(package: str) -> str:
    """The licence in the package's files."""
    return vendored(f"LICENSE.{package}.txt")
