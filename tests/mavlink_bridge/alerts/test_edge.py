"""Texts exist at the edge only: no component holds, compares or parses one."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[3]
CATALOGUE = ROOT / "mavlink_bridge" / "alerts"
PARTS = ("companion", "mavlink_bridge")
READS = "mavlink_bridge.alerts.reading"
RENDERS = {"text", "body", "reason"}
EDGES = {  # STATUSTEXT, records and pages
    "mavlink_bridge/status.py", "mavlink_bridge/injection/shadow.py",
    "companion/alerts/page.py", "companion/flight/component_table.py", "companion/flight/health.py",
    "companion/live/orders.py", "companion/live/shown.py", "companion/offline/shadow_check.py",
    "companion/supervision/supervisor.py",
}  # fmt: skip


def test_only_the_catalogue_holds_texts_and_only_edges_render_them() -> None:
    held, rendering, reading = [], set(), []
    for path in (p for part in PARTS for p in (ROOT / part).rglob("*.py")):
        if path.is_relative_to(CATALOGUE):
            continue
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and "PiLoT: " in str(node.value):
                held.append(f"{name}:{node.lineno}")
            if isinstance(node, ast.ImportFrom) and node.module == READS:
                reading.append(name)
            if (
                isinstance(node, ast.ImportFrom)
                and node.module == "mavlink_bridge.alerts.catalogue"
            ):
                rendering |= {name} & ({name} if RENDERS & {a.name for a in node.names} else set())
    assert held == []
    assert reading == []
    assert rendering == EDGES


def test_edges_never_compare_what_they_render() -> None:
    compared = []
    for name in EDGES:
        for node in ast.walk(ast.parse((ROOT / name).read_text(encoding="utf-8"))):
            inside = list(ast.walk(node)) if isinstance(node, ast.Compare) else []
            calls = [n.func for n in inside if isinstance(n, ast.Call)]
            compared += [f for f in calls if isinstance(f, ast.Name) and f.id in RENDERS]
    assert compared == []
