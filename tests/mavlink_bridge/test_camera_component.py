"""What the camera component tells of targets, and that an ended one is told no more."""

from mavlink_bridge.camera.component import CameraComponent
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import TargetReport

SECOND = 10**9


def test_a_target_that_is_forgotten_is_told_no_more_and_the_others_are():
    component = CameraComponent(BridgeConfig(), 47.5, None, ground_link=True)
    sent = []

    def told(now_ns):
        sent.clear()
        component.tick(now_ns, None, 0, lambda message, _: sent.append(message) or True)
        return [m.lat for m in sent if m.get_type() == "CAMERA_TRACKING_GEO_STATUS"]

    for number, latitude in ((3, 47.3), (4, 47.4)):
        component.report(TargetReport(10 * SECOND, latitude, 8.5, 450.0, target_id=number))
    assert sorted(told(10 * SECOND)) == [473000000, 474000000]
    component.forget(3)
    component.forget(7)  # never reported: no error
    assert told(11 * SECOND) == [474000000]
    component.forget(4)
    assert told(11 * SECOND + SECOND // 2) == []
    assert component.targets == 0
