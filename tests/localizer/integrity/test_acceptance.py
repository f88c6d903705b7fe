"""Which registrations may be used."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localizer.errors import ModelError
from localizer.geometry.pose import Pose
from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
from localizer.integrity.confirmation import (
    Consistency,
    IndependentEvidence,
    TentativeTrack,
    consistency_test,
)
from localizer.integrity.probability import MODEL, log_odds, place_model
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.types import RegistrationStatus

CONFIG = IntegrityConfig()
GOOD = PatchAgreement(patches=60, votes=50, peak=6.0, patch_peak=3.5)


def _registration(**change: Any) -> Registration:
    good = Registration(
        Pose.identity(), np.eye(6), 0.1, 0.9, 0.6, RegistrationStatus.OK, 1, agreement=GOOD
    )
    return replace(good, **change)


@pytest.mark.parametrize(
    "change",
    [
        {"status": RegistrationStatus.NO_TEXTURE},
        {"overlap": 0.1},
        {"quality": 0.05, "agreement": PatchAgreement(60, 8, 2.5, 2.1)},
        {"agreement": None},
    ],
)
def test_every_criterion_can_reject(change: dict[str, Any]) -> None:
    assert is_acceptable(CONFIG, _registration(), 1.0)
    assert not is_acceptable(CONFIG, _registration(**change), 1.0)


def test_a_damaged_place_model_is_named(tmp_path: Path) -> None:
    text = MODEL.read_text(encoding="utf-8")
    missing = tmp_path / "missing.json"
    damaged = ["", text[:200], "[]", '{"features": {}, "bias": 0}', text.replace("patch_peak", "x")]
    files = [tmp_path / f"{k}.json" for k in range(len(damaged))]
    for path, content in zip(files, damaged, strict=True):
        path.write_text(content, encoding="utf-8")
    for path in (missing, *files):
        with pytest.raises(ModelError, match="install the program again"):
            place_model(path)


def test_a_contradicted_prediction_rejects() -> None:
    assert not is_acceptable(CONFIG, _registration(), 1e4)


def test_a_wide_prior_asks_for_more_evidence() -> None:
    doubtful = _registration(quality=0.4, lead=0.2, agreement=PatchAgreement(60, 30, 5.0, 2.9))
    assert is_acceptable(CONFIG, doubtful, 1.0, prior_sigma_m=3.0)
    assert not is_acceptable(CONFIG, doubtful, 1.0, prior_sigma_m=200.0)
    assert is_acceptable(CONFIG, _registration(), 1.0, prior_sigma_m=50.0)


def test_each_kind_of_evidence_counts() -> None:
    base = _registration(lead=0.05)
    less = [
        replace(base, quality=0.2),
        replace(base, lead=0.01),
        replace(base, agreement=PatchAgreement(60, 20, 6.0, 3.5)),
        replace(base, agreement=PatchAgreement(60, 50, 3.0, 3.5)),
        replace(base, agreement=PatchAgreement(60, 50, 6.0, 2.1)),
    ]
    assert all(log_odds(worse) < log_odds(base) for worse in less)


@pytest.mark.parametrize("earlier", [0.6, -math.inf, math.nan])
def test_every_pass_over_an_image_must_show_the_place(earlier):
    assert is_acceptable(CONFIG, _registration(earlier_log_odds=0.8), 1.0)
    assert not is_acceptable(CONFIG, _registration(earlier_log_odds=earlier), 1.0)


def test_another_focal_length_that_fits_better_rejects() -> None:
    assert not is_acceptable(CONFIG, _registration(focal_gain=0.05), 1.0)
    assert is_acceptable(CONFIG, _registration(focal_gain=-0.01), 1.0)


EVIDENCE = st.fixed_dictionaries(
    {
        "overlap": st.floats(0, 1), "quality": st.floats(0, 1), "lead": st.floats(0, 2),
        "votes": st.integers(0, 60), "peak": st.floats(0, 12), "patch_peak": st.floats(0, 8),
    }
)  # fmt: skip


def _with(evidence: dict[str, Any]) -> Registration:
    of_patches = {k: evidence[k] for k in ("votes", "peak", "patch_peak")}
    found = PatchAgreement(patches=60, **of_patches)
    rest = {k: v for k, v in evidence.items() if k not in of_patches}
    return _registration(agreement=found, **rest)


@given(EVIDENCE, EVIDENCE, st.floats(0, 30), st.floats(1, 1000), st.floats(1, 1000))
def test_more_evidence_or_a_narrower_prior_never_costs_an_accepted_place(
    one, other, distance_squared, sigma_m, other_m
):
    less = _with({key: min(one[key], other[key]) for key in one})
    more = _with({key: max(one[key], other[key]) for key in one})
    if is_acceptable(CONFIG, less, distance_squared, max(sigma_m, other_m)):
        assert is_acceptable(CONFIG, more, distance_squared, min(sigma_m, other_m))


@pytest.mark.parametrize("name", ["overlap", "quality", "lead", "peak", "patch_peak"])
def test_evidence_that_is_no_number_accepts_nothing(name):
    good = {
        "overlap": 0.9,
        "quality": 0.6,
        "lead": 1.0,
        "votes": 50,
        "peak": 6.0,
        "patch_peak": 3.5,
    }
    assert is_acceptable(CONFIG, _with(good), 1.0)
    assert not is_acceptable(CONFIG, _with(good | {name: math.nan}), 1.0)
    assert not is_acceptable(CONFIG, _with(good), math.nan)


# --- What confirms a place that was found by searching: a way that was flown, and no noise ------


BEGUN = Pose(np.eye(3), np.array([0.0, 0.0, 100.0]))


def weighed(east_m: float, sigmas_m: tuple[float, float]) -> Consistency:
    """0.2 s after the first acceptance, of estimates with these sigmas, east and north."""
    covariance = np.diag([sigmas_m[0] ** 2, sigmas_m[1] ** 2, 0.01, 1e-4, 1e-4, 1e-4])
    pose = Pose(np.eye(3), np.array([east_m, 0.0, 100.0]))
    tentative_track = TentativeTrack(BEGUN, covariance, 0)
    return consistency_test(
        tentative_track, pose, covariance, 200_000_000, IndependentEvidence(), CONFIG
    )


@pytest.mark.parametrize("east_m", [5.5, -9.0])
def test_estimates_that_slide_along_what_looks_alike_have_flown_no_way(east_m: float) -> None:
    """A row of crops, a street: each fits 3 m beside the one before, and says so. Two of them 5 m
    apart, the same view, were taken for a way over which the map goes on to match.
    """
    assert weighed(east_m, (3.0, 0.1)) is Consistency.PENDING


def test_a_way_that_is_known_confirms_however_unsure_the_other_axis_is() -> None:
    assert weighed(6.0, (0.1, 3.0)) is Consistency.CONFIRMED
    assert weighed(6.0, (0.15, 0.15)) is Consistency.CONFIRMED
    assert weighed(18.0, (3.0, 0.1)) is Consistency.CONFIRMED  # farther than they slide
