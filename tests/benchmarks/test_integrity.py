"""What the integrity benchmark counts: false accepts, losses, and files that were cut short."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from benchmarks.common.shares import exact_interval
from benchmarks.integrity.fit import fit
from benchmarks.integrity.maps import DARK
from benchmarks.integrity.report import DISTINCT, FOCAL, LIKELY, OURS, WITHOUT, rows
from benchmarks.integrity.run import StartOutcome, read
from benchmarks.protection.__main__ import main
from benchmarks.protection.flights import FlownPositions, Position, read_flight, report, share
from localizer.integrity.acceptance import IntegrityConfig
from mavlink_bridge.errors import TlogError
from mavlink_bridge.link.tlog import TlogRecorder

HALVES = {"right": 40, "wrong": 40}
RIGHT = StartOutcome(
    "quito", 0, "day", "near", 3.0, 3.0, True, metres=0.2, degrees=0.1, off_map_m=0.2,
    overlap=0.9, quality=0.6, sigma_m=0.2, gate=3.0, parts=60, votes=57, peak=7.0,
    patch_peak=3.5, lead=1.0,
)  # fmt: skip
WRONG = replace(
    RIGHT,
    kind="far",
    metres=40.0,
    off_map_m=40.0,
    votes=9,
    quality=0.1,
    peak=2.6,
    patch_peak=2.0,
    lead=0.01,
)
ALIKE = replace(WRONG, votes=58, quality=0.6, peak=6.0, lead=0.1)


def of(outcomes: list[StartOutcome], acceptance: str, name: str = "all"):
    made = rows(outcomes, IntegrityConfig())
    return next(r for r in made if (r.set, r.acceptance) == (name, acceptance))


def test_what_the_votes_let_through_and_what_they_cost():
    torn = replace(WRONG, kind="near", metres=0.2, off_map_m=0.2)
    outcomes = [
        RIGHT,
        torn,
        WRONG,
        replace(WRONG, metres=5.0, off_map_m=5.0),
        replace(WRONG, ok=False),
    ]
    before, ours = of(outcomes, WITHOUT), of(outcomes, OURS)
    assert (before.false.hits, before.false_far.hits, before.false.count) == (2, 1, 3)
    assert (before.lost.hits, before.lost.count) == (0, 2)
    assert (ours.false.hits, ours.lost.hits, ours.lost.count) == (0, 1, 2)


def test_a_right_place_from_a_wrong_beginning_is_no_false_accept():
    found = replace(RIGHT, kind="lost")
    assert of([found], OURS).false.hits == 0
    assert of([found], OURS).false.count == 1


def test_the_picture_of_a_shifted_map_is_where_it_shows():
    shifted = replace(RIGHT, set="shifted", kind="far", metres=5.1, off_map_m=0.1)
    assert of([shifted], OURS, "shifted").false.hits == 0


def test_a_wrong_focal_length_and_equal_roofs_are_counted_apart_and_in_all():
    focal = replace(ALIKE, kind="focal", metres=6.0, off_map_m=6.0)
    roofs = replace(ALIKE, set="roofs")
    assert of([focal, roofs], OURS).false.hits == 2
    assert of([focal, roofs], OURS, "all, focal length right").false.hits == 1
    assert (
        of([focal, roofs, RIGHT], OURS, "all, focal length right, no equal roofs").false.hits == 0
    )


def test_a_better_focal_length_and_a_place_that_does_not_stand_out_are_refused_by_ours():
    zoomed = replace(ALIKE, kind="focal", focal_gain=0.05)
    alike = replace(ALIKE, set="roofs", peak=5.0, prior_sigma_m=140.0)
    narrow = replace(RIGHT, set="roofs", peak=5.0, lead=0.1, prior_sigma_m=2.0)
    outcomes = [zoomed, alike, narrow]
    assert (of(outcomes, LIKELY).false.hits, of(outcomes, OURS).false.hits) == (2, 0)
    assert (of(outcomes, FOCAL).false.hits, of(outcomes, DISTINCT).false.hits) == (1, 1)
    assert (of(outcomes, OURS).lost.hits, of(outcomes, OURS).lost.count) == (0, 1)


def drawn(name: str, seed: int) -> list[StartOutcome]:
    """Outcomes of which the right ones have more quality, votes and lead, with noise."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(80):
        base, ground = (RIGHT, 0.5) if k % 2 else (WRONG, 80.0)
        quality = float(np.clip(base.quality + rng.normal(0, 0.05), 0.02, 1))
        votes = int(np.clip(base.votes + rng.normal(0, 4), 0, base.parts))
        made.append(replace(base, set=name, quality=quality, votes=votes, ground_m=ground))
    return made


def test_the_fit_tells_right_from_wrong_on_a_set_that_it_has_not_seen():
    outcomes = [*drawn("quito", 0), *drawn("forest", 1), *drawn("portugal", 2)]
    between = [replace(RIGHT, set="quito", ground_m=4.0)] * 9
    fitted = fit([*outcomes, *between])
    assert fitted["fitted_on"] == dict.fromkeys(("quito", "forest", "portugal"), HALVES)
    for judged in fitted["left_out"].values():
        assert (judged["right_accepted"], judged["wrong_accepted"]) == (1.0, 0)
    swapped = [replace(o, ground_m=80.0 if o.ground_m < 1 else 0.5) for o in outcomes]
    assert fit(swapped)["left_out"]["quito"]["right_accepted"] == 1.0  # it follows the labels
    mixed = [replace(o, ground_m=0.5 if k % 4 < 2 else 80.0) for k, o in enumerate(outcomes)]
    assert fit(mixed)["left_out"]["quito"]["wrong_accepted"] > 0  # labels that say nothing


def test_dark_images_are_judged_by_the_fit_of_others_and_never_fitted():
    outcomes = [*drawn("quito", 0), *drawn("forest", 1), *drawn("portugal", 2)]
    alone = fit(outcomes)
    fitted = fit([*outcomes, *(replace(o, set=DARK + "quito") for o in drawn("quito", 3))])
    judged = fitted.pop("left_out")
    assert fitted | {"left_out": alone["left_out"]} == alone
    assert judged[DARK + "quito"]["wrong"] == HALVES["wrong"]


def test_a_line_that_was_cut_short_costs_its_view_alone(tmp_path):
    path = tmp_path / "quito.jsonl"
    lines = [json.dumps(asdict(replace(RIGHT, view=k))) for k in (0, 1, 1)]
    path.write_text("\n".join(lines)[:-20])
    assert [o.view for o in read(path)] == [0]


@pytest.mark.parametrize(("hits", "count", "high"), [(0, 10_000, 0.0369), (4, 10_000, 0.1024)])
def test_intervals_are_exact(hits, count, high):
    """Upper bounds of 0 and 4 of 10,000: 1 - 0.025^(1/n), and by tables of Clopper and Pearson."""
    assert exact_interval(hits, count)[1] == pytest.approx(high, abs=2e-4)
    assert np.isclose(exact_interval(count, count)[1], 100.0)


# --- Positions of flights inside their protection level: what was withheld was not believed -----


BEGIN_NS = 37_456_555_000_000
STEP_NS = 125_000_000
ESTIMATES = "exposure_time_ns,east_m,north_m,up_m,accepted,hpl_m,vpl_m\n"
FRAMES = "exposure_time_ns,sequence,east_m,north_m,up_m,true_time_ns\n"


def flown(folder: Path, *, late_ns: int = 0, sent: int = 4) -> Path:
    """Ten frames at 8 m/s to the east; the first `sent` of eight estimates were injected.

    late_ns: by which the stamps of the pictures are late.
    """
    record = folder / "companion"
    record.mkdir(parents=True)
    frames, estimates = FRAMES, ESTIMATES
    for k in range(10):
        true_ns = BEGIN_NS + k * STEP_NS
        frames += f"{true_ns + late_ns},{k},{float(k)},0.0,80.0,{true_ns}\n"
        if 0 < k < 9:
            # One that was refused, one without a level, and the others 0.1 m off to the north.
            accepted, level = ("0", "1.5") if k == 7 else ("1", "" if k == 8 else "1.5")
            row = (true_ns + late_ns, float(k), 0.1, 80.2, accepted, level, level)
            estimates += ",".join(map(str, row)) + "\n"
    (folder / "frames.csv").write_text(frames)
    (record / "estimates.csv").write_text(estimates)
    recorder = TlogRecorder(folder / "flight.tlog", lambda _: None)
    recorder.start()
    codec = mavlink.MAVLink(None, 1, 197)
    for k in range(1, 1 + sent):
        usec = (BEGIN_NS + k * STEP_NS + late_ns) // 1000
        message = mavlink.MAVLink_vision_position_estimate_message(usec, 0, 0, 0, 0, 0, 0)
        recorder.write(message.pack(codec), time.time_ns() // 1000)
    recorder.close()
    return folder


def test_what_was_injected_is_told_from_what_was_not(tmp_path: Path) -> None:
    found = read_flight(flown(tmp_path / "embedded-normal-fast-3"))
    assert found.normal
    assert [p.injected for p in found.positions] == [True] * 4 + [False] * 2
    for position in found.positions:
        assert list(position.error_m) == pytest.approx([0.1, 0.2], abs=1e-3)


def test_late_stamps_are_errors_of_the_way_flown_meanwhile(tmp_path: Path) -> None:
    """By the stamped times the pictures would agree with themselves."""
    found = read_flight(flown(tmp_path / "embedded-late-300ms-5", late_ns=125_000_000))
    assert not found.normal
    assert found.positions[0].error_m[0] == pytest.approx(1.005, abs=1e-3)


def of_flown_levels(error_m: float, *, injected: bool = True) -> Position:
    return Position(0, (error_m, 0.0), (1.5, 2.0), injected)


def test_a_withheld_position_that_is_wrong_spoils_no_share() -> None:
    good = FlownPositions("a-normal-fast-1", True, (of_flown_levels(0.2), of_flown_levels(0.3)))
    frozen = FlownPositions(
        "a-frozen-hover-5", False, (of_flown_levels(0.1), of_flown_levels(30.0, injected=False))
    )
    found = report([good, frozen])["shares"]
    assert (found["all, injected"]["within_hpl"], found["all, injected"]["positions"]) == (3, 3)
    assert found["all, not injected"]["within_hpl"] == 0
    assert found["all, not injected"]["worst_share"] == pytest.approx(20.0)
    assert "normal, not injected" not in found
    late = FlownPositions("a-late-300ms-5", False, (of_flown_levels(0.1), of_flown_levels(3.0)))
    counted = share([good, late], injected=True)
    assert (counted.flights, counted.flights_whole, counted.within_hpl) == (2, 1, 3)
    assert counted.low < 75.0 < counted.high


def test_what_cannot_be_counted_is_named_and_the_rest_is_written(tmp_path, monkeypatch, capsys):
    flight = flown(tmp_path / "embedded-normal-fast-3")
    shifted = flown(tmp_path / "ardupilot-map-shifted-15m-5")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(TlogError, match="shifted"):
        read_flight(shifted)
    out = tmp_path / "flights.json"
    arguments = ["protection", "--flights", *map(str, (flight, shifted, empty)), "--out", str(out)]
    monkeypatch.setattr("sys.argv", arguments)
    main()
    found = json.loads(out.read_text())["more"]
    assert found["shares"]["normal, injected"]["positions"] == 4
    assert set(found["left_out"]) == {shifted.name, "empty"}
    assert "| normal, injected | 1, 1 whole | 4 of 4" in capsys.readouterr().out
