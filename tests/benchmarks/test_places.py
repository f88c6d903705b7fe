"""The table of the six places: a fair order, what counts, and figures that follow from the JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("torch")

from benchmarks.places.flights import CONDITIONS, FULL, cells, first_frame
from benchmarks.places.rivals import Rendered, RivalPose, Setting
from benchmarks.places.run import PlacesPlan
from benchmarks.places.table import markdown, measures, read_results, write_json
from benchmarks.places.worlds import PLACES
from localizer.config import LocalizerConfig
from localizer.errors import SequenceError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.types import Frame, PosePrior, RenderedView

METHODS = ("orb", "ours")
NADIR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 50.0]))


def test_any_six_in_a_row_are_all_places_and_all_conditions_and_heights_take_turns():
    order = cells()
    assert len({c.name for c in order}) == len(order) == 6 * 6 * 2
    for k in range(0, len(order), 6):
        some = order[k : k + 6]
        assert {c.place.name for c in some} == {p.name for p in PLACES}
        assert {c.condition for c in some} == set(CONDITIONS)
    half = order[:36]
    for condition in CONDITIONS:
        heights = [c.height for c in half if c.condition == condition]
        assert heights.count("low") == heights.count("high") == 3


def test_a_short_run_takes_frames_from_anywhere_and_a_full_one_all():
    order = cells()
    begins = [first_frame(c, 30) for c in order]
    assert min(begins) >= 0
    assert max(begins) <= FULL - 30
    assert len(set(begins)) > 30
    assert {first_frame(c, FULL) for c in order} == {0}


def _plan(tmp_path, count=4):
    (tmp_path / "results").mkdir()
    return PlacesPlan(tmp_path, 3, 320, METHODS, tuple(cells()[:count]))


def _done(plan, cell, method, metres):
    document = {
        "place": cell.place.name, "condition": cell.condition, "height": cell.height,
        "method": method, "metres": metres, "degrees": [None if m is None else 0.5 for m in metres],
        "cpu_ms": [100.0] * len(metres),
    }  # fmt: skip
    plan.result(cell, method).write_text(json.dumps(document))


def test_only_sequences_that_every_method_has_done_are_counted(tmp_path):
    plan = _plan(tmp_path)
    assert "No sequence" in markdown(plan, read_results(plan))
    first, second, *_ = plan.cells
    _done(plan, first, "orb", [0.5, None, 4.0, 2.0])
    _done(plan, first, "ours", [0.1, 0.2, 0.3, 0.4])
    _done(plan, second, "ours", [9.0] * 4)
    assert plan.missing(first) == ()
    assert plan.missing(second) == ("orb",)
    results = read_results(plan)
    assert len(results) == 2
    text = markdown(plan, results)
    assert "1 of 4 sequences" in text
    assert "(4 in all)" in text
    orb = measures([r for r in results if r.method == "orb"])
    assert orb.median_translation_m == 2.0
    assert (orb.recall_1, orb.recall_3, orb.recall_5) == (25.0, 50.0, 75.0)
    assert orb.completeness == 75.0
    assert orb.fps == pytest.approx(10.0)
    write_json(plan, results, tmp_path)
    rows = json.loads((tmp_path / "six-places.json").read_text())["rows"]
    assert next(r for r in rows if r[0] == "Render2ORB")[5] == "1 of 3"
    assert next(r for r in rows if r[0] == "ours")[3].startswith("100.0 / 100.0 / 100.0")
    recall = json.loads((tmp_path / "six-places-recall.json").read_text())
    assert recall["columns"] == ["", "Render2ORB", "ours"]
    assert next(r for r in recall["rows"] if r[0] == first.condition)[1] == "50 [50, 50]"
    assert f"| {first.condition} | 1 |" in text


def test_a_damaged_result_is_named(tmp_path):
    plan = _plan(tmp_path, 1)
    for method in METHODS:
        plan.result(plan.cells[0], method).write_text("{}")
    with pytest.raises(SequenceError, match="not a result of this benchmark"):
        read_results(plan)


class _Flat:
    """Ground 50 m below, wherever the camera is."""

    def __init__(self):
        self.asked = []

    def render(self, world_from_camera, camera, extra=(), *, wait=False):
        self.asked.append(world_from_camera)
        shape = (camera.height, camera.width)
        rgb = np.zeros((*shape, 3), np.uint8)
        return RenderedView(rgb, np.full(shape, 50.0, np.float32), world_from_camera, camera)


class _Stack:
    def __init__(self):
        self.renderer = _Flat()


def test_a_rival_is_rendered_for_where_it_predicts_itself_and_not_where_it_is():
    """It flies 1 m a frame; from the third frame on its own velocity carries it."""
    camera = Camera.from_fov(320, 240, 60.0)
    stack, true_m = _Stack(), [0.0]

    def step(view, image, prior, seed):
        pose = Pose(NADIR.rotation, NADIR.translation + np.array([true_m[0], 0.0, 0.0]))
        return RivalPose(pose, np.eye(6) * 1e-4)

    rival = Rendered(stack, Setting(camera, LocalizerConfig()), step)
    rival.begin(PosePrior(NADIR, np.eye(6), 10**9))
    image = np.zeros((240, 320, 3), np.uint8)
    for k in range(8):
        true_m[0] = float(k)
        found = rival.track(Frame(image, 10**9 + k * 10**8, camera, k), 3 if k == 0 else 1)
        assert found.translation[0] == k
    assert stack.renderer.asked[-1].translation[0] == pytest.approx(7.0, abs=0.3)
    assert len(stack.renderer.asked) == 3 + 7
