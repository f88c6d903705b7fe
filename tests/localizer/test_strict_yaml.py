"""Strict YAML: what a settings file may not say."""

import pytest
import yaml

from localizer.strict_yaml import load_yaml


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3, column 1"),
        ("top:\n  rate: 1\n  rate: 1\n", "line 3, column 3"),
        ("- {x: 1, y: 2, x: 1}\n", "line 1, column 16"),
        ("1: a\n0x1: b\n", "line 2, column 1"),
    ],
)
def test_a_key_that_stands_twice_is_refused_with_its_place(text: str, where: str) -> None:
    with pytest.raises(yaml.YAMLError, match="stands twice") as error:
        load_yaml(text)
    assert where in str(error.value)


def test_the_same_key_in_two_mappings_is_no_repetition() -> None:
    assert load_yaml("a: {x: 1}\nb: {x: 2}\n") == {"a": {"x": 1}, "b": {"x": 2}}


def test_a_merged_key_may_be_overridden() -> None:
    text = "base: &b {x: 1, y: 2}\nin: {own: &o {<<: *b, x: 3}}\nother: {<<: *o, y: 4}\n"
    assert load_yaml(text)["in"]["own"] == {"x": 3, "y": 2}
    assert load_yaml(text)["other"] == {"x": 3, "y": 4}


@pytest.mark.parametrize("text", ["!!python/object/apply:os.system ['true']", "? [a]\n: 1\n"])
def test_it_makes_plain_types_only(text: str) -> None:
    with pytest.raises(yaml.YAMLError):
        load_yaml(text)
