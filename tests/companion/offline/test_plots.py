import cv2
import numpy as np
import pytest

from companion.offline.plots import ErrorSeries, MapPicture, plot_errors, plot_tracks

TIME = np.linspace(-5.0, 10.0, 60)


def _height_of_curve(path):
    """Rows (of the figure) that the curve in the first colour spans."""
    image = cv2.imread(str(path)).astype(int)
    blue = (np.abs(image - (180, 119, 31)).max(axis=-1) < 40).any(axis=1)  # C0, BGR
    return int(np.flatnonzero(blue)[-1] - np.flatnonzero(blue)[0])


@pytest.mark.parametrize("spans", [(), ((0.0, 8.0, "denied"),)])
def test_an_outlier_outside_the_spans_does_not_flatten_the_curve(tmp_path, spans):
    error = 1.0 + 0.8 * np.sin(TIME)
    plot_errors(tmp_path / "a.png", [ErrorSeries("x", TIME, error, "m")], spans)
    error[3] = 500.0  # before the span
    error[30] = np.nan
    plot_errors(tmp_path / "b.png", [ErrorSeries("x", TIME, error, "m")], spans)
    gone = ErrorSeries("x", TIME, np.full(60, np.nan), "m")
    plot_errors(tmp_path / "c.png", [gone], spans)
    if spans:
        assert _height_of_curve(tmp_path / "b.png") >= 0.9 * _height_of_curve(tmp_path / "a.png")


def test_tracks_that_coincide_are_all_seen(tmp_path):
    way = np.column_stack([np.linspace(0, 300, 200), 80 * np.sin(np.linspace(0, 6, 200))])
    path = tmp_path / "tracks.png"
    colours = {"w": (255, 255, 255), "tab:orange": (14, 127, 255), "k": (0, 0, 0)}  # BGR
    grey = MapPicture(np.full((8, 8, 3), 120, np.uint8), -100, 400, -200, 200)
    plot_tracks(path, {"truth": way, "EKF": way, "localizer": way}, grey, {})
    image = cv2.imread(str(path)).astype(int)
    height, width = image.shape[:2]
    inside = image[height // 3 : 2 * height // 3, width // 5 : 4 * width // 5]
    for name, colour in colours.items():
        assert (np.abs(inside - colour).max(axis=-1) < 30).sum() > 300, name
