"""What a flight draws: within its scenario, reproducible, and nothing in the ideal world."""

import numpy as np
import pytest

from sitl.camera.detector import DetectorErrors
from sitl.camera.realism import CameraRealism
from sitl.demo.budget import draw_errors
from sitl.demo.scenario import Scenario


def test_the_ideal_flight_has_no_errors_at_all():
    ideal = Scenario().ideal()
    drawn = draw_errors(ideal, seed=3)
    assert drawn.camera == ideal.camera.camera()
    assert ideal.camera.camera().readout_ms == 0
    assert drawn.lever_arm_m == (0.0, 0.0, 0.0)
    assert drawn.map_shift_m == (0.0, 0.0, 0.0)
    assert drawn.realism == CameraRealism()
    assert drawn.detector == DetectorErrors()


def test_every_error_is_drawn_and_spreads_as_the_scenario_says():
    scenario, nominal = Scenario(), Scenario().camera.camera()
    drawn = [draw_errors(scenario, seed) for seed in range(200)]
    assert drawn[7] == draw_errors(scenario, 7)
    spreads = {
        "focal": ([100 * (d.camera.fx / nominal.fx - 1) for d in drawn], 0.1),
        "principal": ([d.camera.cx - nominal.cx for d in drawn], 0.7),
        "k1": ([d.camera.distortion[0] - nominal.distortion[0] for d in drawn], 0.003),
        "lever": ([d.lever_arm_m[1] for d in drawn], 0.05),
        "stamp": ([d.realism.stamp_offset_ms for d in drawn], 3.0),
        "readout": ([d.realism.readout_ms - nominal.readout_ms for d in drawn], 1.0),
        "up": ([d.map_shift_m[2] for d in drawn], 0.3),
    }
    for name, (values, sigma) in spreads.items():
        assert np.std(values) == pytest.approx(sigma, rel=0.2), name
        assert abs(np.mean(values)) < 0.25 * sigma, name
    away = np.array([np.hypot(*d.map_shift_m[:2]) for d in drawn])
    assert 0.3 <= away.min() < 0.4
    assert 1.4 < away.max() <= 1.5
    assert len({np.sign(d.map_shift_m[0]) for d in drawn}) == 2
