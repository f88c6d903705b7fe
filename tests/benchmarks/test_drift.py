"""The drift benchmark: which samples count, what is fitted, and what the priors believe."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.bridge.drift import Drift, drifts, fitted, read
from companion.flight.priors import drift_sigma_m


def sample(seconds, error_m):
    health = "localization tracking" if seconds is None else f"localization lost {seconds} s"
    return {"health": health, "error_m": error_m}


def test_a_loss_counts_from_a_right_position_until_the_ekf_has_none():
    way = [sample(None, 0.3), *(sample(t, 0.3 + 0.02 * t * t) for t in range(1, 13))]
    still = [sample(t, way[-1]["error_m"]) for t in range(13, 22)]
    found = drifts("a", [*way, *still, sample(None, 0.2)])
    assert [d.seconds for d in found] == [4.5, 9.5]
    assert found[1].error_m == pytest.approx(0.3 + 0.02 * 81)
    assert found[1].believed_m == drift_sigma_m(9.5)
    assert drifts("b", [sample(t, 20.0 + t) for t in range(1, 13)]) == []  # was wrong before


def test_the_fit_finds_what_was_drawn():
    rng = np.random.default_rng(0)
    found = []
    for t in np.tile([5.0, 10.0, 15.0, 20.0], 200):
        sigma = 0.1 * t + 0.03 * t * t
        found.append(Drift("a", t, float(rng.rayleigh(sigma)), drift_sigma_m(t)))
    fit = fitted(found)
    assert fit.acceleration_m_s2 == pytest.approx(0.03, abs=0.006)
    assert fit.believed_covers > 0.95 * fit.errors  # 0.15 t + 0.05 t² is larger


def test_flights_that_were_fed_what_is_wrong_are_left_out(tmp_path):
    samples = {"samples": [sample(t, 0.1 * t) for t in range(1, 13)]}
    for name in ("ardupilot-covered-30s-5", "ardupilot-spoofed-slowly-5"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "flight.json").write_text(json.dumps(samples))
    assert {d.flight for d in read(tmp_path)} == {"ardupilot-covered-30s-5"}
