"""The example detector beside a listener of the companion: what it sees is what arrives."""

import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from companion.targets.detections import DetectionListener
from mavlink_bridge.link.link import sleep_until

EXAMPLE = Path(__file__).parents[2] / "examples" / "detector_client.py"
MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


def _deployment(folder, port, boxes):
    """A deployment whose feed is grey images, in each a red box (u, v, side) or None."""
    images = folder / "images"
    images.mkdir()
    lines = []
    for k, box in enumerate(boxes):
        image = np.full((120, 160, 3), 90, np.uint8)
        if box is not None:
            u, v, side = box
            image[v : v + side, u : u + side] = (20, 20, 220)  # BGR
        cv2.imwrite(str(images / f"{k:02}.png"), image)
        lines.append(f"{k:02}.png {(k + 1) * 10**8}")
    (images / "timestamps.txt").write_text("\n".join(lines))
    settings = {
        "map": "map",
        "camera": {"source": str(images), "model": MODEL, "settings": {"realtime": False}},
        "targets": {"detections": f"127.0.0.1:{port}"} if port else {},
    }
    path = folder / "deployment.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def _run(path):
    return subprocess.run(
        [sys.executable, str(EXAMPLE), *([str(path)] if path else [])],
        capture_output=True, text=True, timeout=300, check=False, cwd=EXAMPLE.parents[1],
        env={"PYTHONPATH": str(EXAMPLE.parents[1]), "PATH": ""},
    )  # fmt: skip


def test_every_red_box_arrives_with_its_frames_time_and_nothing_else(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    boxes = [(20, 30, 10), None, (100, 60, 6), (50, 50, 2)]  # the last one is too small
    got: list[Any] = []
    listener = DetectionListener(f"127.0.0.1:{port}", lambda detection, _: got.append(detection))
    try:
        done = _run(_deployment(tmp_path, port, boxes))
        assert done.stdout == "2 detections sent\n", done.stderr
        assert sleep_until(lambda: len(got) == 2, 30.0)
    finally:
        listener.close()
    assert [d.time_ns for d in got] == [10**8, 3 * 10**8]
    np.testing.assert_allclose([(d.u, d.v) for d in got], [(25.0, 35.0), (103.0, 63.0)])
    assert {d.target_id for d in got} == {"red"}
