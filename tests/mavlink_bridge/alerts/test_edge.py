"""Texts exist at the edge only: no component holds, compares or parses one."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from mavlink_bridge.alerts.alert import PREFIX
from mavlink_bridge.alerts.ids import AlertId

ROOT = Path(__file__).parents[3]
ALERTS = "mavlink_bridge/alerts/"
READS = "mavlink_bridge.alerts.reading"
RENDERS = {"text", "body", "reason"}
EDGES = {  # STATUSTEXT, records and pages
    "mavlink_bridge/status.py", "mavlink_bridge/injection/shadow.py",
"companion/flight/component_table.py", "companion/flight/health.py",
    "companion/live/orders.py", "companion/live/shown.py", "companion/offline/shadow_check.py",
    "companion/supervision/supervisor.py",
}  # fmt: skip
PARSES = {  # methods of a text, and of `re`
    "startswith", "endswith", "find", "index", "count", "split", "rsplit", "partition",
    "rpartition", "removeprefix", "removesuffix", "match", "search", "fullmatch", "findall",
}  # fmt: skip
OUTSIDE = {  # why a value is a `Name` and none of a closed list
    "mavlink_bridge/bridge.py": "the system's error",
    "mavlink_bridge/components.py": "an address",
    "mavlink_bridge/vehicle_events.py": "an address",
    "mavlink_bridge/injection/fix_sender.py": "a MAVLink message of the configuration",
    "companion/flight/component_table.py": "an address",
    "companion/integrity_monitor/integrity_monitor.py": "a thread",
    "companion/supervision/supervisor.py": "a thread, or a signal",
    "companion/targets/target_manager.py": "a target",
}
AUTOPILOT_TEXTS = {"mavlink_bridge/injection/switching.py"}  # ArduPilot's "Using EKF Source Set"


@cache
def components() -> dict[str, ast.Module]:
    paths = (p for part in ("companion", "mavlink_bridge") for p in (ROOT / part).rglob("*.py"))
    named = ((path.relative_to(ROOT).as_posix(), path) for path in paths)
    return {n: ast.parse(p.read_text("utf-8")) for n, p in named if not n.startswith(ALERTS)}


def imported(tree: ast.Module, module: str) -> set[str]:
    found = (n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module == module)
    return {alias.name for node in found for alias in node.names}


def users() -> dict[str, ast.Module]:
    """What raises or takes alerts."""
    ids = "mavlink_bridge.alerts.ids"
    return {name: tree for name, tree in components().items() if imported(tree, ids)}


def test_only_the_catalogue_holds_texts_and_only_edges_render_them() -> None:
    trees, catalogue = components(), "mavlink_bridge.alerts.catalogue"
    paths = (p for p in ROOT.glob("[a-z]*/**/*.py") if ALERTS not in p.as_posix())
    assert not [path.as_posix() for path in paths if PREFIX in path.read_text("utf-8")]
    assert not [name for name, tree in trees.items() if imported(tree, READS)]
    assert {n for n, tree in trees.items() if RENDERS & imported(tree, catalogue)} == EDGES


def compared(tree: ast.AST, of: set[str]) -> Iterator[ast.expr]:
    """What compares or parses a rendered text, or a name that holds one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            inside: list[ast.expr] = [node.left, *node.comparators]
        elif isinstance(node, ast.Subscript):
            is_cut = isinstance(node.slice, ast.Slice) and node.slice.lower is None
            inside = [] if is_cut else [node.value]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            inside = [node.func.value, *node.args] if node.func.attr in PARSES else []
        else:
            continue
        if any(renders(one, of) for one in inside):
            yield node


def renders(node: ast.AST, of: set[str]) -> bool:
    named = (n.id for n in ast.walk(node) if isinstance(n, ast.Name) and type(n.ctx) is ast.Load)
    return bool(of.intersection(named))


def holding(tree: ast.AST) -> set[str]:
    """The functions that render, and the variables that are assigned what one returns."""
    found = set(RENDERS)
    for node in (n for n in ast.walk(tree) if isinstance(n, ast.Assign)):
        called = (c.func for c in ast.walk(node.value) if isinstance(c, ast.Call))
        if any(isinstance(f, ast.Name) and f.id in RENDERS for f in called):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return found


@pytest.mark.parametrize("name", sorted(EDGES))
def test_edges_never_compare_or_parse_what_they_render(name: str) -> None:
    tree = components()[name]
    functions = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef))
    assert [ast.unparse(c) for f in functions for c in compared(f, holding(f))] == []


@pytest.mark.parametrize(
    "code",
    ["x = text(a) == 'b'", "x = body(a)\ny = x.startswith('b')", "x = re.match(P, reason(a))",
     "x = text(a)\ny = 'b' in x", "x = text(a)[7:]"],
)  # fmt: skip
def test_a_comparison_would_be_found(code: str) -> None:
    tree = ast.parse(code)
    assert list(compared(tree, holding(tree)))


def test_users_of_alerts_compare_no_sentence_and_search_none() -> None:
    """Identifiers, words of a closed list and numbers are compared; a sentence has spaces."""
    sentences, searching = [], set()
    for name, tree in users().items():
        for node in ast.walk(tree):
            called = node.func if isinstance(node, ast.Call) else None
            is_parse = isinstance(called, ast.Attribute) and called.attr in PARSES
            if is_parse or isinstance(node, ast.Compare):
                inside = (c.value for c in ast.walk(node) if isinstance(c, ast.Constant))
                sentences += [one for one in inside if isinstance(one, str) and " " in one.strip()]
            if isinstance(node, ast.Import) and any(alias.name == "re" for alias in node.names):
                searching.add(name)
    assert sentences == []
    assert searching == AUTOPILOT_TEXTS


def test_values_that_are_names_come_from_outside() -> None:
    """mypy takes no `str` as a value: it is a word of a closed list, or a `Name` of these."""
    made = set()
    for name, tree in components().items():
        calls = (n.func for n in ast.walk(tree) if isinstance(n, ast.Call))
        if any(isinstance(f, ast.Name) and f.id == "Name" for f in calls):
            made.add(name)
    assert made == set(OUTSIDE)


def test_every_alert_is_raised() -> None:
    trees = components().values()
    named = {n.attr for t in trees for n in ast.walk(t) if isinstance(n, ast.Attribute)}
    values = {spec.name for spec in AlertId}
    assert values - named == set()
