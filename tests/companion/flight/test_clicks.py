"""When an operator's click is placed, and by which frame."""

from types import SimpleNamespace

import pytest

from companion.flight.clicks import ClickPolicy
from mavlink_bridge.messages import TrackRequest


@pytest.mark.parametrize(("age_s", "placed"), [(0.3, True), (2.5, False), (None, False)])
def test_a_click_is_not_placed_by_an_old_pose(age_s, placed):
    """The operator points into the present picture, and is told when nobody knows where it is."""
    second, now_ns = 10**9, 10**12
    detections, texts = [], []
    clicks = ClickPolicy(detections.append, lambda _, text: texts.append(text))
    if age_s is not None:
        exposure_ns, camera = now_ns - round(age_s * second), SimpleNamespace(width=160, height=120)
        clicks.add_estimate(
            SimpleNamespace(camera=camera, exposure_time_ns=exposure_ns, accepted=True)
        )
    for k in range(5):  # an impatient operator
        clicks.on_request(TrackRequest("point", now_ns + k, (0.5, 0.25)))
    clicks.on_request(TrackRequest("stop", now_ns))
    assert [(d.u, d.v) for d in detections] == ([(80.0, 30.0)] * 5 if placed else [])
    told = ["PiLoT: no target: the camera's position is not known"]
    assert texts == ([] if placed else told)
