"""The geoid against values that its makers and others published."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.geometry.geoid import geoid_separation


@pytest.mark.parametrize(
    ("latitude", "longitude", "published"),
    [  # NGA's test of its EGM96 interpolation program (OUTPUT.DAT)
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ],
)
def test_published_values(latitude, longitude, published):
    assert geoid_separation(latitude, longitude) == pytest.approx(published, abs=0.2)


def test_the_extremes_are_where_they_are():
    assert geoid_separation(4.75, 78.75) == pytest.approx(-106.9, abs=0.5)  # south of India
    assert geoid_separation(90, 0) == pytest.approx(13.6, abs=0.1)
    assert geoid_separation(-90, 0) == pytest.approx(-29.5, abs=0.1)


def test_it_is_continuous_over_every_seam():
    for latitude in (-89.99, -45.125, 0.0, 61.875):
        for longitude in (-180.0, 0.0, 90.25, 180.0):
            near = [
                geoid_separation(latitude + a, longitude + b)
                for a in (-1e-7, 1e-7) for b in (-1e-7, 1e-7)
            ]  # fmt: skip
            assert np.ptp(near) < 1e-3
    assert geoid_separation(10, -190) == pytest.approx(geoid_separation(10, 170))
