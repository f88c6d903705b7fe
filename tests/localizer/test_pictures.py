"""Image files at any path that a file system takes."""

import os

import numpy as np
import pytest

from localizer.errors import SequenceError
from localizer.pictures import read_rgb, write_rgb


@pytest.mark.parametrize("name", [b"plain.png", b"kr\xfcger.png"])  # Latin-1, no UTF-8
def test_what_is_written_is_read(tmp_path, name):
    path = tmp_path / os.fsdecode(name)
    image = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    write_rgb(path, image)
    assert np.array_equal(read_rgb(path), image)


def test_what_is_no_image_is_named(tmp_path):
    path = tmp_path / "a.jpg"
    with pytest.raises(SequenceError, match=r"a\.jpg: cannot be read"):
        read_rgb(path)
    path.write_bytes(b"")
    with pytest.raises(SequenceError, match=r"a\.jpg"):
        read_rgb(path)
    path.write_bytes(b"no image")
    with pytest.raises(SequenceError, match=r"a\.jpg: not an image"):
        read_rgb(path)
