"""A rendered board before a drawn lens: printed, seen, solved, and what was missing said."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image as PillowImage
from typer.testing import CliRunner

from companion.calibrate.board import (
    ACROSS,
    DOWN,
    BoardViews,
    board_picture,
    solve_lens,
    write_sheet,
)
from companion.calibrate.pictures import PictureReader
from companion.cli.commands import app
from companion.config import load_config
from companion.errors import RecordError, ReportError
from localizer.features.detail import DetailExtractor
from localizer.features.gradient import GradientExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, matrix_from_euler
from localizer.types import Frame, RenderedView

TRUE = Camera(640, 480, 505.0, 503.0, 327.0, 236.0, (-0.11, 0.03, 0.0007, -0.0004, 0.0))
DOTS = 40


def shown(camera: Camera, place: tuple[float, float, float], tilt_deg: tuple[float, float]):
    """The board's middle at `place` (squares, camera axes), turned about its y and x axes."""
    board = cv2.copyMakeBorder(
        board_picture(DOTS), DOTS, DOTS, DOTS, DOTS, cv2.BORDER_CONSTANT, value=255
    )
    board = cv2.GaussianBlur(board, (0, 0), 1.2)
    R = matrix_from_euler(np.radians(tilt_deg[1]), np.radians(tilt_deg[0]), 0.0)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([u, v], axis=-1) + 0.5)
    normal, middle = R[:, 2], np.array(place)
    depth = (normal @ middle) / (rays @ normal)
    on_board = (rays * depth[..., None] - middle) @ R
    x = (on_board[..., 0] + ACROSS / 2 + 1) * DOTS - 0.5
    y = (on_board[..., 1] + DOWN / 2 + 1) * DOTS - 0.5
    grey = cv2.remap(
        board, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, None,
        cv2.BORDER_CONSTANT, 120,
    )  # fmt: skip
    noise = np.random.default_rng(round(1e3 * sum(place))).normal(0, 2, grey.shape)
    return np.repeat(np.clip(grey + noise, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


POSES = [
    ((x, y, z), tilt)
    for (x, y, z), tilt in zip(
        [(0, 0, 13), (0, 0, 13), (0, 0, 13), (0, 0, 14), (0, 0, 14), (-5.5, -3, 16), (5.5, -3, 16),
         (-5.5, 3, 16), (5.5, 3, 16), (-4, 0, 15), (4, 0, 15), (0, -3, 15), (0, 3, 15), (0, 0, 11),
         (-6, -4, 17), (6, 4, 17), (6, -4, 17), (-6, 4, 17), (0, 1, 12), (-2, 2, 20), (2, -2, 20),
         (-3.5, -2.5, 11), (3.5, 2.5, 11), (3.5, -2.5, 11), (-3.5, 2.5, 11)],
        [(0, 0), (30, 0), (-30, 0), (0, 30), (0, -30), (20, 0), (-20, 0), (0, 20), (0, -20),
         (25, 10), (-25, 10), (10, 25), (10, -25), (0, 0), (-30, 0), (30, 0), (0, 35), (0, -35),
         (15, 15), (-35, 20), (35, -20), (10, 0), (-10, 0), (0, 10), (0, -10)], strict=True,
    )
]  # fmt: skip


@pytest.fixture(scope="module")
def taken() -> BoardViews:
    views = BoardViews(TRUE.width, TRUE.height)
    for place, tilt in POSES:
        picture = shown(TRUE, place, tilt)
        views.add_image(picture)
        views.add_image(picture)  # held still
    return views


def test_the_lens_is_found_within_its_sigmas(taken: BoardViews):
    lens = solve_lens(taken.views, TRUE.width, TRUE.height)
    found = np.array([lens.camera.fx, lens.camera.fy, lens.camera.cx, lens.camera.cy])
    truth = np.array([TRUE.fx, TRUE.fy, TRUE.cx, TRUE.cy])
    assert lens.views[0] >= 16
    assert lens.rms_px < 0.3
    assert np.abs(found - truth)[:2].max() < 0.0005 * TRUE.fx
    assert np.abs(found - truth)[2:].max() < 0.4
    assert np.abs((found - truth) / lens.sigmas[:4]).max() < 4.0
    assert lens.sigmas[0] < 0.01 * TRUE.fx


def test_what_is_missing_is_said_and_nothing_at_the_end(taken: BoardViews):
    few = BoardViews(TRUE.width, TRUE.height)
    for _ in range(2):
        few.add_image(shown(TRUE, (0, 0, 13), (0, 0)))
    told = " ".join(few.missing())
    assert "turned left" in told
    assert "top, left edge" in told
    assert len(taken.missing()) <= 2
    assert len(few.missing()) > 10


def test_a_board_that_moves_or_was_seen_is_not_taken():
    views = BoardViews(TRUE.width, TRUE.height)
    assert views.add_image(np.full((480, 640, 3), 90, np.uint8)).startswith("no board")
    assert views.add_image(shown(TRUE, (0, 0, 13), (0, 0))) == "hold it still"
    assert views.add_image(shown(TRUE, (0.4, 0, 13), (0, 0))) == "hold it still"
    assert views.add_image(shown(TRUE, (0.4, 0, 13), (0, 0))) == "taken"
    assert views.add_image(shown(TRUE, (0.4, 0, 13), (0, 0))).startswith("like one")
    with pytest.raises(RecordError, match="1 usable views"):
        solve_lens(views.views, 640, 480)


def test_the_sheet_prints_at_true_scale(tmp_path):
    sheet = write_sheet(tmp_path / "board.pdf", "a4")
    data = (tmp_path / "board.pdf").read_bytes()
    (box,) = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", data)
    assert [float(x) * 25.4 / 72 for x in box] == pytest.approx([210, 297], abs=0.1)
    (size,) = re.findall(rb"/Width (\d+)", data)
    assert 200 * 210 / int(size) == pytest.approx(sheet.square_mm, rel=1e-3)  # mm of a square
    assert b"/DCTDecode" not in data  # a lossy picture would blur the edges
    assert sheet.square_mm * DOWN < sheet.height_mm - 2 * 10
    write_sheet(tmp_path / "board.png", "a4")
    page = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert page.shape[1] / page.shape[0] == pytest.approx(210 / 297, rel=1e-3)
    with PillowImage.open(tmp_path / "board.png") as opened:
        assert opened.info["dpi"] == pytest.approx((25.4 * 200 / sheet.square_mm,) * 2, rel=1e-3)
    with pytest.raises(ReportError, match=r"--print .*ends in \.pdf or \.png"):
        write_sheet(tmp_path / "board.svg", "a4")


def test_the_command_reads_a_folder_and_changes_the_deployment(tmp_path):
    folder = tmp_path / "shots"
    folder.mkdir()
    for number, (place, tilt) in enumerate(POSES[:12]):
        picture = shown(TRUE, place, tilt)
        for again in range(2):
            cv2.imwrite(str(folder / f"{2 * number + again:03d}.png"), picture[..., ::-1])
    path = tmp_path / "deployment.yaml"
    model = {"width": 1280, "height": 720, "fx": 900, "fy": 900, "cx": 640, "cy": 360}
    document = {
        "map": str(tmp_path), "camera": {"source": "udp://0.0.0.0:5600", "model": model},
        "bridge": {"connection": "udpin:127.0.0.1:14550"},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(document))
    command = [
        "calibrate",
        "board",
        str(folder),
        "--config",
        str(path),
        "--keep",
        str(tmp_path / "k"),
    ]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "missing: the board in the image" in done.output
    after = load_config(path).camera.model
    assert (after.width, after.height) == (640, 480)
    assert after.fx == pytest.approx(TRUE.fx, rel=0.01)
    assert len(list((tmp_path / "k").glob("*.png"))) == 12
    assert (tmp_path / "deployment.yaml.before-calibration").exists()


# --- A picture through a longer lens than the deployment's, laid on the map part by part --------


CAMERA = Camera.from_fov(320, 240, 65.0)


class Plane:
    """A renderer of one textured plane 100 m below, whatever it is asked."""

    def __init__(self, depth_m: float = 100.0) -> None:
        self.depth_m = depth_m
        noise = np.random.default_rng(3).normal(size=(240, 320, 3)).astype(np.float32)
        smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
        self.rgb = np.clip(128 + 400 * smooth, 0, 255).astype(np.uint8)

    def render(self, pose, camera, extra=(), *, wait=False):
        return RenderedView(self.rgb, np.full((240, 320), self.depth_m, np.float32), pose, camera)


@pytest.mark.parametrize("longer", [1.0, 1.008])
def test_each_part_is_found_where_the_picture_has_it(longer):
    plane = Plane()
    middle = np.array([CAMERA.cx - 0.5, CAMERA.cy - 0.5])
    scale = np.hstack([longer * np.eye(2), ((1 - longer) * middle)[:, None]])
    image = cv2.warpAffine(plane.rgb, scale, (320, 240), flags=cv2.INTER_LINEAR)
    reader = PictureReader(plane, DetailExtractor(GradientExtractor()), CAMERA, 320)
    pose = Pose.identity()
    parts = reader.read(Frame(image, 0, CAMERA, 0), pose, None)
    assert len(parts.points) > 40
    expected, _ = CAMERA.project(parts.points)
    expected = (expected - (CAMERA.cx, CAMERA.cy)) * longer + (CAMERA.cx, CAMERA.cy)
    off = np.hypot(*(parts.pixels - expected).T)
    assert np.median(off) < 0.1
    assert np.percentile(off, 90) < 0.3


def test_a_view_beside_the_map_gives_nothing():
    plane = Plane(depth_m=0.0)
    reader = PictureReader(plane, DetailExtractor(GradientExtractor()), CAMERA, 320)
    assert reader.read(Frame(plane.rgb, 0, CAMERA, 0), Pose.identity(), None) is None
