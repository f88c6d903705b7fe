"""Which registrations may be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
from localizer.integrity.probability import log_odds
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.types import RegistrationStatus

CONFIG = IntegrityConfig()
GOOD = PatchAgreement(patches=60, votes=50, peak=6.0)


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
        {"quality": 0.05, "agreement": PatchAgreement(patches=60, votes=8, peak=2.5)},
        {"agreement": None},
    ],
)
def test_every_criterion_can_reject(change: dict[str, Any]) -> None:
    assert is_acceptable(CONFIG, _registration(), 1.0)
    assert not is_acceptable(CONFIG, _registration(**change), 1.0)


def test_a_contradicted_prediction_rejects() -> None:
    assert not is_acceptable(CONFIG, _registration(), 1e4)


def test_a_wide_prior_asks_for_more_evidence() -> None:
    doubtful = _registration(
        quality=0.4, lead=0.2, agreement=PatchAgreement(patches=60, votes=30, peak=5.0)
    )
    assert is_acceptable(CONFIG, doubtful, 1.0, prior_sigma_m=3.0)
    assert not is_acceptable(CONFIG, doubtful, 1.0, prior_sigma_m=200.0)
    assert is_acceptable(CONFIG, _registration(), 1.0, prior_sigma_m=50.0)


def test_each_kind_of_evidence_counts() -> None:
    base = _registration(lead=0.05)
    less = [
        replace(base, quality=0.2),
        replace(base, lead=0.01),
        replace(base, agreement=PatchAgreement(60, 20, 6.0)),
        replace(base, agreement=PatchAgreement(60, 50, 3.0)),
    ]
    assert all(log_odds(worse) < log_odds(base) for worse in less)


def test_another_focal_length_that_fits_better_rejects() -> None:
    assert not is_acceptable(CONFIG, _registration(focal_gain=0.05), 1.0)
    assert is_acceptable(CONFIG, _registration(focal_gain=-0.01), 1.0)
