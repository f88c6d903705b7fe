"""The numbers that targets have in MAVLink."""

from companion.targets.numbers import TargetNumbers


def test_a_name_keeps_its_number_and_a_click_its_own():
    numbers = TargetNumbers()
    first, second = numbers.number_of("car a"), numbers.number_of("car b")
    assert first != second
    assert numbers.number_of("car a") == first
    assert numbers.number_of("ground station 7") == 7
    assert numbers.number_of("console 8") == 8


def test_names_without_end_take_no_memory_without_end():
    """A detector names what it sees anew as long as it flies; no number is given twice."""
    numbers = TargetNumbers()
    kept = numbers.number_of("kept")
    given = set()
    for k in range(2000):
        given.add(numbers.number_of(f"thing {k}"))
        assert numbers.number_of("kept") == kept  # what is still there is not forgotten
    assert len(given) == 2000
    assert kept not in given
    assert numbers.number_of("thing 0") not in given  # it was forgotten
