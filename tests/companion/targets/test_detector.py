"""The detector in the companion's process: the layouts of its networks, names, and what fails."""

import threading
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from companion.config import DetectorConfig
from companion.errors import DetectorError
from companion.targets.detector.boxes import decode, layout_of
from companion.targets.detector.names import LocatedBox, ObjectNames
from companion.targets.detector.network import DetectorNetwork
from companion.targets.detector.worker import BoxDetector
from localizer.types import Frame
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.targets.scene import CAMERA, MS, cast, estimate, pose_at

SIZE = (128, 96)  # of the network's pictures
CELLS = sum((SIZE[0] // s) * (SIZE[1] // s) for s in (8, 16, 32))
CAR = (64.0, 48.0, 20.0, 10.0)  # centre, width and height, in the network's pixels
SECOND = 10**9


def output_of(layout, score=0.9, classes=2):
    """A car (class 1) seen twice beside itself, and a person (class 0) that is hardly seen."""
    u, v, w, h = CAR
    if layout == "end2end":
        corners = [u - w / 2, v - h / 2, u + w / 2, v + h / 2]
        few = [[*corners, score, 1.0], [0, 0, 9, 9, 0.1, 0.0]] + [[0.0] * 6] * 298
        return np.array([few], np.float32)
    cells = CELLS * (3 if layout == "v5" else 1)
    rows = np.zeros((cells, 4 + classes), np.float32)
    rows[5], rows[6] = [u, v, w, h, 0, score], [u + 1, v, w, h, 0, score - 0.1]
    rows[40] = [9, 9, 8, 8, 0.1, 0]
    if layout == "v5":
        sure = np.ones((cells, 1), np.float32)
        return np.hstack([rows[:, :4], sure, rows[:, 4:]])[None]
    return np.ascontiguousarray(rows.T)[None]


def model(folder, output, names="{0: 'person', 1: 'car'}", fails=False):
    """A network that says the same of every picture; fails: where the picture is bright."""
    size = list(SIZE)[::-1]
    nodes = [helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0)]
    zero = numpy_helper.from_array(np.float32(0), "zero")
    said = numpy_helper.from_array(output, "said")
    nodes += [
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["said", "nothing"], ["output0"]),
    ]
    graph = helper.make_graph(
        nodes, "net",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, *size])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, list(output.shape))],
        [zero, said],
    )  # fmt: skip
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    made.ir_version = 8
    if names:
        entry = made.metadata_props.add()
        entry.key, entry.value = "names", names
    path = folder / "net.onnx"
    onnx.save(made, path)
    return path


@pytest.mark.parametrize("layout", ["v5", "v8", "end2end"])
def test_each_layout_is_known_by_its_shape_and_gives_the_same_box(layout, tmp_path):
    path = model(tmp_path, output_of(layout))
    network = DetectorNetwork(DetectorConfig(model=path, classes=("car",)))
    # A picture of another shape than the network's: twice as large, with bars above and below.
    (box,) = network.detect(np.zeros((160, 256, 3), np.uint8))
    assert network.name_of(box.label) == "car"
    assert box.score == pytest.approx(0.9, abs=1e-6)
    middle = (0.5 * (box.left + box.right), 0.5 * (box.top + box.bottom))
    assert middle == pytest.approx((2 * 64.0, 2 * (48.0 - 8.0)))
    assert (box.right - box.left, box.bottom - box.top) == pytest.approx((40.0, 20.0))


def test_a_shape_that_two_layouts_have_is_no_guess():
    assert layout_of((1, 3 * CELLS, 6), 1, SIZE) == ("v5", 1)
    assert layout_of((1, 300, 6), None, SIZE) == ("end2end", 0)
    assert layout_of((1, 84, CELLS), None, SIZE) == ("v8", 80)
    for shape, classes in (
        ((1, 1000, 7), None), ((1, 7), None), ((2, 84, CELLS), 80), ((1, 84, CELLS), 3)
    ):  # fmt: skip
        with pytest.raises(DetectorError):
            layout_of(shape, classes, SIZE)


def test_scores_below_the_threshold_and_broken_boxes_are_dropped():
    output = output_of("v8")
    assert len(decode(output, "v8", 0.5)) == 1  # the second car is the first one
    assert decode(output, "v8", 0.95) == []
    output[0, 0, 5] = np.nan
    assert [box.score for box in decode(output, "v8", 0.5)] == pytest.approx([0.8])


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (lambda folder: {"model": folder / "none.onnx"}, "no such file"),
        (lambda folder: {"model": _broken(folder)}, "no ONNX network"),
        (lambda folder: {"model": model(folder, output_of("v8")), "classes": ("boat",)}, "boat"),
        (lambda folder: {"model": model(folder, output_of("v8")), "labels": ("a",) * 3}, "layout"),
        (lambda folder: {"model": model(folder, np.zeros((1, 7, 11), np.float32))}, "fits 0"),
    ],
)
def test_what_is_wrong_with_a_model_is_named(made, why, tmp_path):
    with pytest.raises(DetectorError, match=why):
        DetectorNetwork(DetectorConfig(**made(tmp_path)))


def _broken(folder):
    path = folder / "net.onnx"
    path.write_bytes(b"not a network")
    return path


def test_a_thing_keeps_its_name_while_it_drives_and_a_single_sight_has_none():
    names, told = ObjectNames(), []
    for k in range(8):  # two cars that pass each other, half a second apart
        a = LocatedBox("car", np.array([8.0 * 0.5 * k, 0.0, 0.0]))
        b = LocatedBox("car", np.array([30.0 - 8.0 * 0.5 * k, 4.0, 0.0]))
        shown = [a, b] if k % 2 else [b, a]
        found = names.name(shown, k * SECOND // 2)
        told.append(found if k % 2 else found[::-1])
    assert told[0] == [None, None]
    assert told[1:] == [["car 2", "car 1"]] * 7
    again = names.name([LocatedBox("boat", np.zeros(3))], 4 * SECOND)
    assert again == [None]
    assert names.name([LocatedBox("car", np.array([500.0, 0.0, 0.0]))], 5 * SECOND) == [None]


class Fake(DetectorNetwork):
    """A network of which a test says what it sees."""

    def __init__(self, see):
        self._see = see

    def detect(self, image):
        return self._see(image)

    def name_of(self, _label):
        return "car"


class Flight:
    """A `BoxDetector` with pictures; the next one comes when the last was taken to be looked at."""

    def __init__(self, see):
        self.told: list[Any] = []
        self.said: list[Any] = []
        self.looks = 0
        self._taken = threading.Semaphore(0)

        def look(image):
            self.looks += 1
            self._taken.release()
            return see(image)

        config = DetectorConfig(model="x.onnx", rate_hz=30, duty=1.0)
        self.detector = BoxDetector(
            config, cast, self.told.append, self.said.append,
            load=lambda _: Fake(look),
        )  # fmt: skip
        self.detector.start()

    def offer(self, k):
        """Picture and pose number k, as the engine offers them."""
        time_ns = k * 100 * MS
        image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
        self.detector.add_frame(Frame(image, time_ns, CAMERA, sequence=k))
        self.detector.add_estimate(estimate(pose_at(0.0), time_ns))

    def fly(self, looks):
        """So many pictures, and the end."""
        for k in range(1, looks + 1):
            self.offer(k)
            assert self._taken.acquire(timeout=600.0)
        self.detector.stop()


def test_what_is_seen_twice_is_told_at_its_own_frames_time(tmp_path):
    network = DetectorNetwork(DetectorConfig(model=model(tmp_path, output_of("v8"))))
    flight = Flight(network.detect)
    flight.fly(4)
    assert flight.detector.looked == 4
    assert {d.target_id for d in flight.told} == {"detector car 1"}
    assert all(d.time_ns % (100 * MS) == 0 for d in flight.told)
    assert (flight.told[0].u, flight.told[0].v) == pytest.approx((320.0, 240.0))
    assert flight.said == []


def test_a_network_that_fails_is_counted_and_given_up_and_the_flight_goes_on():
    def fail(_image):
        raise RuntimeError("out of memory")

    flight = Flight(fail)
    flight.fly(3)
    assert flight.looks == 3
    assert not flight.detector.is_working
    assert flight.detector.failed == 4
    assert flight.said == [alert(AlertId.DETECTOR_OFF)]


def test_a_model_that_is_not_there_is_told_in_flight():
    said: list[Alert] = []
    detector = BoxDetector(DetectorConfig(model="none.onnx"), cast, pytest.fail, said.append)
    detector.start()
    detector.stop()
    assert said == [alert(AlertId.DETECTOR_OFF)]
    assert detector.failed == 1


def test_a_slow_network_never_holds_up_who_offers_it_pictures():
    """It stands still in its picture; a thousand more are offered and dropped meanwhile."""
    goes_on, entered = threading.Event(), threading.Event()

    def stand(_image):
        entered.set()
        goes_on.wait(600.0)
        return []

    flight = Flight(stand)
    for k in range(1, 1001):
        flight.offer(k)
        if k == 1:
            assert entered.wait(600.0)
    assert flight.detector.looked == 0  # still in the first one
    goes_on.set()
    flight.detector.stop()
    assert flight.detector.looked <= 2
