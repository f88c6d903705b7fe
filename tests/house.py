"""The rules of the house, read from source text: sizes, one-way imports, nothing private named.

Python files are given as a mapping of paths (POSIX, from the repository's root) to their text.
Only what a search of the text makes suspect is parsed, so that the whole tree takes a second.
"""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

PACKAGES = ("localizer", "mavlink_bridge", "companion", "sitl", "benchmarks")
MOST_MODULES, MOST_LINES, MOST_METHODS = 15, 200, 15

# Which packages each may import.
_MAY_IMPORT = {
    "localizer": set[str](),
    "mavlink_bridge": set[str](),
    "companion": {"localizer", "mavlink_bridge"},
    "sitl": {"localizer", "mavlink_bridge", "companion"},
    "benchmarks": {"localizer", "mavlink_bridge", "companion", "sitl"},
}
_IMPORT = re.compile(r"^[ \t]*(?:from ([\w.]+) import (\([^)]*\)|[^\n]*)|import ([\w.]+))", re.M)
# numba has no public way to its runtime.
_PRIVATE = re.compile(
    r"^[ \t]*from (?!numba\.core\.runtime)\S+ import (?:\([^)]*|.*)\b(?<!as )_[a-z]\w*"
    r"|set(?:attr|item)\([^)]*?[\"'.]_[a-z]\w*[\"']", re.M,
)  # fmt: skip
_WAITS = re.compile(r"thread\w*\.join\((?:None)?\)", re.IGNORECASE)
_FLIES = ("companion/", "mavlink_bridge/", "localizer/tracking/", "localizer/map/cache/")
_CLASS = re.compile(r"^class .*\n(?:(?:[ \t)].*)?\n)*", re.M)  # up to the next line at column 0


def sources(root: Path) -> dict[str, str]:
    """The Python files of packages and tests."""
    folders = (*PACKAGES, "tests", "examples")
    return {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for folder in folders
        for path in (root / folder).rglob("*.py")
    }


def crowded_folders(files: Mapping[str, str]) -> list[str]:
    """Folders of packages with too many modules."""
    paths = [PurePosixPath(path) for path in files]
    count = Counter(p.parent for p in paths if p.name != "__init__.py" and p.parts[0] in PACKAGES)
    return [f"{folder}: {n} modules" for folder, n in count.items() if n > MOST_MODULES]


def large_classes(files: Mapping[str, str]) -> list[str]:
    """Classes of packages that are too large and whose docstring says no reason, as ``Above 200
    lines: ...`` or ``Above 15 public methods: ...``.
    """
    return [
        f"{path}: {problem}"
        for path, text in files.items()
        if path.split("/")[0] in PACKAGES
        for match in _CLASS.finditer(text)
        if _may_be_large(match.group())
        for node in ast.walk(ast.parse(match.group()))
        if isinstance(node, ast.ClassDef) and (problem := _too_large(node))
    ]


def _may_be_large(text: str) -> bool:
    return text.count("\n") > MOST_LINES or text.count(" def ") > MOST_METHODS


def _too_large(node: ast.ClassDef) -> str:
    lines = (node.end_lineno or node.lineno) - node.lineno + 1
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    methods = sum(isinstance(m, kinds) and not m.name.startswith("_") for m in node.body)
    told = re.search(r"Above [^:]*:", " ".join((ast.get_docstring(node) or "").split()))
    reason = "" if told is None else told.group()
    if lines > MOST_LINES and f"{MOST_LINES} lines" not in reason:
        return f"{node.name} has {lines} lines, and its docstring says no reason"
    if methods > MOST_METHODS and f"{MOST_METHODS} public methods" not in reason:
        return f"{node.name} has {methods} public methods, and its docstring says no reason"
    return ""


def wrong_imports(files: Mapping[str, str]) -> list[str]:
    """Imports against the one direction: sitl -> companion -> localizer, mavlink_bridge."""
    return [
        f"{path} imports {module}"
        for path, text in files.items()
        if path.split("/")[0] in PACKAGES
        for module in _imported(path, text, files)
        if (top := module.split(".")[0]) in PACKAGES
        and top != path.split("/")[0]
        and top not in _MAY_IMPORT[path.split("/")[0]]
    ]


def folder_circles(files: Mapping[str, str]) -> list[str]:
    """Folders of packages that import each other, over any number of others. A folder and those in
    it count as one place.
    """
    graph: dict[str, set[str]] = defaultdict(set)
    for path, text in files.items():
        here = path.rpartition("/")[0]
        if path.split("/")[0] not in PACKAGES:
            continue
        for module in _imported(path, text, files):
            there = module.replace(".", "/")
            there = there if f"{there}/__init__.py" in files else there.rpartition("/")[0]
            nested = f"{there}/".startswith(f"{here}/") or f"{here}/".startswith(f"{there}/")
            if there.count("/") and here.count("/") and not nested:
                graph[here].add(there)
    return _circles(graph)


def module_circles(files: Mapping[str, str]) -> list[str]:
    """Modules of packages that import each other, in functions and for types, too."""
    graph: dict[str, set[str]] = defaultdict(set)
    for path, text in files.items():
        here = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        if path.split("/")[0] in PACKAGES:
            graph[here] = set(_imported(path, text, files)) - {here}
    return _circles(graph)


def _circles(graph: dict[str, set[str]]) -> list[str]:
    while leaves := {one for one in graph if not graph[one] & graph.keys()}:
        for one in leaves:
            del graph[one]
    return [f"{here} -> {', '.join(sorted(graph[here] & graph.keys()))}" for here in sorted(graph)]


def _imported(path: str, text: str, files: Mapping[str, str]) -> Iterator[str]:
    """The modules and packages of ours that a file imports."""
    for match in _IMPORT.finditer(text):
        module, names, plain = match.groups()
        if plain is not None:
            yield plain
            continue
        for name in re.findall(r"(\w+)(?: as \w+)?\s*(?:,|\)|$|#)", names.strip("( \n") + ","):
            inner = f"{module}.{name}"
            is_module = f"{inner.replace('.', '/')}.py" in files
            yield inner if is_module else module


def endless_waits(files: Mapping[str, str]) -> list[str]:
    """Where what flies waits for a thread without a limit: one that hangs would keep the record and
    the link to the autopilot from being closed.
    """
    return [
        f"{path}: {match.group()} has no limit; use companion.ending.joined"
        for path, text in files.items()
        if path.startswith(_FLIES)
        for match in _WAITS.finditer(text)
    ]


def private_names(files: Mapping[str, str]) -> list[str]:
    """Where a file imports or sets an underscored name of another; ruff (SLF) finds the other uses.
    A test may set a module's constant (``_CLOSE_S``), so that a limit of time is reached sooner.
    """
    return [f"{p}: {m.group()}" for p, text in files.items() for m in _PRIVATE.finditer(text)]
