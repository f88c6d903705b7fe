"""The house stays as CONTRIBUTING.md says: each rule, and that it finds what breaks it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.house import (
    crowded_folders,
    endless_waits,
    folder_circles,
    large_classes,
    long_signatures,
    private_reaches,
    sources,
    wrong_imports,
)

RULES = (
    crowded_folders,
    large_classes,
    long_signatures,
    wrong_imports,
    folder_circles,
    private_reaches,
    endless_waits,
)


@pytest.fixture(scope="module")
def files():
    return sources(Path(__file__).resolve().parents[1])


@pytest.mark.parametrize("rule", RULES)
def test_the_house_keeps_its_rules(files, rule):
    assert len(files) > 500
    assert rule(files) == []


LONG = "class A:\n    '''{}'''\n" + "    x = 1\n" * 200
WIDE = "class A:\n    '''{}'''\n" + "".join(f"    def f{n}(self): ...\n" for n in range(16))


@pytest.mark.parametrize(
    ("rule", "broken", "problems"),
    [
        (crowded_folders, {f"sitl/demo/m{n}.py": "" for n in range(16)}, 1),
        (crowded_folders, {f"sitl/demo/m{n}.py": "" for n in range(15)}, 0),
        (large_classes, {"localizer/a.py": LONG.format("Does much.")}, 1),
        (large_classes, {"localizer/a.py": LONG.format("Above 200 lines: one thread.")}, 0),
        (large_classes, {"localizer/a.py": WIDE.format("Above 200 lines: one thread.")}, 1),
        (large_classes, {"localizer/a.py": WIDE.format("Above 15 public methods: a face.")}, 0),
        (large_classes, {"tests/a.py": WIDE.format("")}, 0),
        (long_signatures, {"localizer/a.py": "def f(a, b, c, d, e, f, g, h): ...\n"}, 1),
        (
            long_signatures,
            {"sitl/a.py": "class A:\n    def f(self, a, b, c, d, e, f, g): ...\n"},
            0,
        ),
        (long_signatures, {"localizer/a.py": "@njit\ndef f(a, b, c, d, e, f, g, h): ...\n"}, 0),
        (wrong_imports, {"localizer/a.py": "from mavlink_bridge import bridge\n"}, 1),
        (wrong_imports, {"mavlink_bridge/a.py": "def f():\n    import companion.flight\n"}, 1),
        (wrong_imports, {"companion/a.py": "from mavlink_bridge import bridge\n"}, 0),
        (endless_waits, {"companion/a.py": "self._thread.join()\n"}, 1),
        (endless_waits, {"companion/a.py": "self._thread.join(2.0)\n", "sitl/a.py": LONG}, 0),
        (private_reaches, {"sitl/a.py": "from sitl.b import _c\n"}, 1),
        (private_reaches, {"sitl/a.py": "def f(b):\n    return b._c\n"}, 1),
        (private_reaches, {"tests/a.py": "monkeypatch.setattr(Link, '_serve', None)\n"}, 1),
        (private_reaches, {"tests/a.py": "monkeypatch.setattr('sitl.a._WAIT_S', 1)\n"}, 0),
        (
            private_reaches,
            {"sitl/a.py": "class A:\n    def __eq__(self, o):\n        return self._c == o._c\n"},
            0,
        ),
    ],
)
def test_each_rule_finds_what_breaks_it(rule, broken, problems):
    assert len(rule(broken)) == problems


@pytest.mark.parametrize("back", ["import sitl.a.m\n", "from sitl.a import (\n    m,  # it\n)\n"])
def test_a_circle_of_folders_is_found_over_a_third(back):
    inits = {f"sitl/{name}/__init__.py": "" for name in "abc"}
    chain = {
        "sitl/a/m.py": "from sitl.b.m import x\n",
        "sitl/b/m.py": "from sitl.c import m\n",
        "sitl/c/m.py": "x = 1\n",
    }
    assert folder_circles(inits | chain) == []
    assert len(folder_circles(inits | chain | {"sitl/c/m.py": back})) == 3
