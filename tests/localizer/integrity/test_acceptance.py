"""Which registrations may be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.types import RegistrationStatus

CONFIG = IntegrityConfig()


def _registration(**change: Any) -> Registration:
    good = Registration(Pose.identity(), np.eye(6), 0.1, 0.9, 0.9, RegistrationStatus.OK, 1)
    return replace(good, **change)


@pytest.mark.parametrize(
    "change",
    [
        {"status": RegistrationStatus.NO_TEXTURE},
        {"overlap": 0.1},
        {"quality": 0.01},
        {"covariance": np.eye(6) * 100.0},
    ],
)
def test_every_criterion_can_reject(change: dict[str, Any]) -> None:
    assert is_acceptable(CONFIG, _registration(), 1.0)
    assert not is_acceptable(CONFIG, _registration(**change), 1.0)


def test_the_gate_rejects() -> None:
    assert not is_acceptable(CONFIG, _registration(), 1e4)


def test_equal_roofs_are_refused_where_the_prior_cannot_tell_them_apart() -> None:
    """All parts agree, the quality is good: with a prior of 20 m it may be the next roof."""
    alike = _registration(agreement=PatchAgreement(patches=60, votes=58, peak=3.2))
    assert not is_acceptable(CONFIG, alike, 1.0, prior_sigma_m=20.0)
    assert is_acceptable(CONFIG, alike, 1.0, prior_sigma_m=3.0)


def test_a_place_like_no_other_needs_no_narrow_prior() -> None:
    seen = _registration(agreement=PatchAgreement(patches=60, votes=58, peak=6.2))
    assert is_acceptable(CONFIG, seen, 1.0, prior_sigma_m=200.0)
    assert is_acceptable(CONFIG, _registration(), 1.0, prior_sigma_m=200.0)  # a GPU has no votes


def test_another_focal_length_that_fits_better_rejects() -> None:
    assert not is_acceptable(CONFIG, _registration(focal_gain=0.05), 1.0)
    assert is_acceptable(CONFIG, _registration(focal_gain=-0.01), 1.0)
