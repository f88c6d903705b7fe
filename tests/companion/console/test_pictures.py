"""What a page is sent: the picture as wide as it is shown, and the map as seen from its pose."""

import json
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest

from companion.console.pictures import OverlayFrame, ReferenceImage, map_at_pose, page_message
from companion.live.protocol import MessageDecoder
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import DOWN
from tests.companion.console.companion_flying import CAMERA, HEIGHT_M

OFF_M = (4.0, -3.0, 2.0)  # of the estimate to the reference's pose: more than any prediction is


@pytest.fixture(scope="module")
def views(small_assets):
    """The map rendered at the reference's pose, and at the estimated one."""
    cache = TileCache.open(small_assets.map_cache)
    streamer = TileStreamer(cache)
    renderer = NumbaRenderer(streamer)
    at = np.array([0.0, 0.0, float(cache.index.box_min[0, 2]) + HEIGHT_M])
    poses = [Pose(DOWN, at), Pose(DOWN, at + OFF_M)]
    yield [renderer.render(pose, CAMERA, wait=True) for pose in poses]
    streamer.close()


def _difference(found, wanted):
    return float(np.abs(found.astype(float) - wanted.astype(float)).mean())


def test_the_map_is_carried_to_the_estimated_pose(views):
    """Followed at every fourth pixel only; what is rendered there is the truth."""
    reference, truth = views
    view = ReferenceImage(reference.rgb, reference.depth, CAMERA, reference.world_from_camera)
    picture = OverlayFrame(truth.rgb, CAMERA, truth.world_from_camera, view)
    half = (CAMERA.width // 2, CAMERA.height // 2)
    wanted = cv2.resize(truth.rgb, half, interpolation=cv2.INTER_AREA)
    carried = _difference(map_at_pose(picture), wanted)
    stayed = _difference(
        map_at_pose(replace(picture, pose=reference.world_from_camera)), wanted
    )  # fmt: skip
    assert carried < 0.6 * stayed


def _message(flight_image: np.ndarray, camera: Camera):
    shown = {
        "kind": "frame", "exposure_ns": 1, "published_ns": 2,
        "image": [flight_image.shape[1], flight_image.shape[0]], "camera": camera.to_dict(),
    }  # fmt: skip
    text = json.dumps(shown).encode()
    data = struct.pack(">II", len(text), flight_image.nbytes) + text + flight_image.tobytes()
    (message,) = MessageDecoder().feed(data)
    return message


@pytest.mark.parametrize(
    ("width_px", "sent"), [(480, [480, 360]), (960, [640, 480])], ids=["shrunk", "never widened"]
)
def test_a_picture_is_sent_no_wider_than_it_is_shown(width_px, sent):
    camera = Camera.from_fov(640, 480, 60.0)
    data = page_message(_message(np.full((480, 640, 3), 90, np.uint8), camera), False, width_px)
    (size,) = struct.unpack_from("<I", data)
    head = json.loads(data[4 : 4 + size])
    jpeg = np.frombuffer(data[4 + size : 4 + size + head["parts"][0]], np.uint8)
    assert head["image"] == sent
    assert list(cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape[1::-1]) == sent
    assert head["width_px"] == 640  # of the camera, in whose pixels targets are told
