"""The house stays as CONTRIBUTING.md says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.house import (
    crowded_folders,
    endless_waits,
    folder_circles,
    large_classes,
    module_circles,
    private_names,
    sources,
    wrong_imports,
)

RULES = (
    crowded_folders,
    large_classes,
    wrong_imports,
    folder_circles,
    module_circles,
    private_names,
    endless_waits,
)


@pytest.fixture(scope="module")
def files():
    return sources(Path(__file__).resolve().parents[1])


@pytest.mark.parametrize("rule", RULES)
def test_the_house_keeps_its_rules(files, rule):
    assert len(files) > 500
    assert rule(files) == []
