"""What a benchmark gives to another process can be found there."""

from __future__ import annotations

import ast

import pytest

from tests.benchmarks.commands import COMMANDS, source

PACKAGES = [name for name in COMMANDS if source(name).name == "__main__.py"]
_CALLS = ("Process", "ProcessPoolExecutor", "submit", "map", "partial")


def given_away(text: str) -> set[str]:
    """Functions and classes of a module that it gives to other processes, or may."""
    tree = ast.parse(text)
    own = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    given = {
        argument.id
        for call in calls
        if (call.func.attr if isinstance(call.func, ast.Attribute) else
            getattr(call.func, "id", "")) in _CALLS
        for argument in (*call.args, *(keyword.value for keyword in call.keywords))
        if isinstance(argument, ast.Name)
    }  # fmt: skip
    return own & given


@pytest.mark.parametrize("name", PACKAGES)
def test_nothing_of_a_packages_main_goes_to_another_process(name: str) -> None:
    # A spawned process does not import `PACKAGE.__main__`, so that it finds nothing of it.
    assert not given_away(source(name).read_text())


@pytest.mark.parametrize(
    "text",
    [
        "def work(): ...\nProcess(target=work)",
        "def work(): ...\nget_context('spawn').Process(target=work, args=(1,))",
        "def work(): ...\npool.submit(work, 1)",
        "def work(): ...\npool.map(partial(work, 1), jobs)",
        "def work(): ...\nrun(views, partial(work, 1))",
        "def work(): ...\nProcessPoolExecutor(2, initializer=work)",
    ],
)
def test_it_would_be_seen(text: str) -> None:
    assert given_away(text) == {"work"}


def test_what_stands_in_another_module_is_found() -> None:
    text = "from benchmarks.basin.run import work\npool.submit(work, 1)"
    assert not given_away(text)
