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


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("base: &b {x: 1}\nown: {<<: *b, y: 3}\n", "line 2, column 7"),
        ("base: &b {x: 1}\nown:\n  <<: [*b, *b]\n", "line 3, column 3"),
        ("base: &b {x: 1}\nown: {!!merge any: *b}\n", "line 2, column 7"),
        ("base: &b {x: 1}\nown: {? !!merge [x] : *b}\n", "line 2, column 9"),
    ],
)
def test_a_merge_key_is_refused_with_its_place(text: str, where: str) -> None:
    with pytest.raises(yaml.YAMLError, match="the merge key << is not read") as error:
        load_yaml(text)
    assert where in str(error.value)


def test_an_alias_and_a_quoted_merge_key_are_read() -> None:
    assert load_yaml("base: &b {x: 1}\nown: *b\n")["own"] == {"x": 1}
    assert load_yaml("'<<': 1\n") == {"<<": 1}


@pytest.mark.parametrize("text", ["!!python/object/apply:os.system ['true']", "? [a]\n: 1\n"])
def test_it_makes_plain_types_only(text: str) -> None:
    with pytest.raises(yaml.YAMLError):
        load_yaml(text)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("fx: 8:20\n", "base 60, as 500"),
        ("fx: 8:20.5\n", "base 60, as 500.5"),
        ("fx: -1:30\n", "base 60, as -90"),
        ("fx: 0100\n", "base 8, as 64"),
        ("8:20: fx\n", "base 60, as 500"),
        ("k: [0.1, {deep: 1:00}]\n", "base 60, as 60"),
    ],
)
def test_a_number_that_says_another_one_is_refused(text: str, read: str) -> None:
    with pytest.raises(yaml.YAMLError, match=read) as error:
        load_yaml(text)
    assert "line 1, column" in str(error.value)


def test_plain_numbers_and_text_with_colons_are_read_as_they_stand() -> None:
    text = "a: 500\nb: 1_000\nc: 0x10\nd: '8:20'\ne: udp://127.0.0.1:5600\nf: 0\ng: 0.5\nh: -07.5"
    assert load_yaml(text) == {
        "a": 500, "b": 1000, "c": 16, "d": "8:20", "e": "udp://127.0.0.1:5600", "f": 0, "g": 0.5,
        "h": -7.5,
    }  # fmt: skip
