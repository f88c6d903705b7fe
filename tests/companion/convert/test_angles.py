"""The tables of angles.md say what the conversions say."""

import pytest

from companion.convert.angles import Angles, AutopilotAngles, pose_of_autopilot
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.posefile import pose_row


@pytest.mark.parametrize(
    ("gimbal", "row"),
    [
        ((0, -40, 60), (0, 50, -60)),  # the figure's
        ((0, -90, 0), (0, 0, 0)),  # straight down, the picture's top to the north
        ((0, 0, -90), (0, 90, 90)),  # level, to the west
    ],
)
def test_the_tables_zeros_and_signs(gimbal, row):
    place = Geodetic(47.3, 8.5, 500.0)
    level = AutopilotAngles("", None, place, Angles(0.0, 0.0, 0.0), Angles(*gimbal))
    found = pose_row("", pose_of_autopilot(level, LocalFrame(place)), LocalFrame(place))
    assert (found.roll_deg, found.pitch_deg, found.yaw_deg) == pytest.approx(row, abs=1e-9)
