"""Which registrations may be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
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
