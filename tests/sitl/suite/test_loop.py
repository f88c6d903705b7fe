"""What is judged of a flight with the whole companion in the loop, and that its files hold."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sitl.demo.scenario import ScenarioError
from sitl.suite.loop.case import Expectation, load_loop_cases
from sitl.suite.loop.judge import LoopRecord, LoopSample, LoopText, judge, untold_s

GOOD = LoopSample(0.0, 0.3, 0.0, 0.0, "AUTO", "ok", "localization tracking", 0.5)


def flight(errors_m: list[float], level: str = "ok", age_s: float = 0.5) -> tuple[LoopSample, ...]:
    """A sample every half second."""
    return tuple(
        replace(GOOD, at_s=0.5 * n, error_m=error, level=level, age_s=age_s)
        for n, error in enumerate(errors_m)
    )


def test_an_error_with_every_light_green_is_untold() -> None:
    assert untold_s(flight([0.5] * 4 + [20.0] * 11), 10.0) == pytest.approx(5.0)


@pytest.mark.parametrize("told", [{"level": "failed"}, {"age_s": 5.0}])
def test_a_bad_health_or_a_silent_companion_tells_it(told: dict[str, float]) -> None:
    assert untold_s(flight([20.0] * 11, **told), 10.0) == 0.0  # type: ignore[arg-type]


def record(samples: tuple[LoopSample, ...], errors: tuple[float, ...] = (0.2,)) -> LoopRecord:
    text = LoopText(1.0, 191, 4, "PiLoT: withheld: video frozen 5 s")
    return LoopRecord(samples, (text,), errors)


def test_every_expectation_can_fail() -> None:
    expect = Expectation(
        never_modes=("LAND",),
        max_error_m=3.0,
        ends_tracking=True,
        says=("video frozen",),
        silent=True,
    )
    good = {h.what: h.ok for h in judge(record(flight([0.5] * 4)), expect)}
    assert [what for what, ok in good.items() if not ok] == ["no warning"]
    landed = tuple(replace(s, mode="LAND", level="failed") for s in flight([9.0] * 4))
    bad = judge(record(landed, errors=(0.2, 7.0)), replace_says(expect))
    assert [h.ok for h in bad] == [True, False, False, False, False, False, False]
    assert not judge(record((), errors=()), Expectation())[0].ok


def replace_says(expect: Expectation) -> Expectation:
    return expect.model_copy(update={"says": ("another text",)})


def test_the_shipped_flights_hold_together() -> None:
    cases = {case.name: case for case in load_loop_cases()}
    assert {"normal", "frozen-hover", "covered-30s", "killed", "other-map"} <= set(cases)
    assert sum(case.ci for case in cases.values()) == 3
    with pytest.raises(ScenarioError, match="no nowhere"):
        load_loop_cases(["nowhere"])
