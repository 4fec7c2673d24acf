"""Files that play hold the images that went in."""

import errno
import os

import av
import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import DiskFullError
from chronoscene.images.animation import write_animation

COLORS = ((200, 60, 40), (30, 90, 210), (90, 160, 60))
IMAGES = [np.full((31, 45, 3), color, np.uint8) for color in COLORS for _ in range(3)]


def test_mp4_has_every_image_in_its_colours_and_an_even_size(tmp_path):
    write_animation(tmp_path / "a.mp4", iter(IMAGES), 12.5)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, float(stream.average_rate)) == ("h264", 12.5)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(frames) == 9 and frames[0].shape == (32, 46, 3)
    for frame, image in zip(frames, IMAGES, strict=True):
        assert np.abs(frame.astype(int) - image[0, 0]).max() <= 4


def test_webp_has_every_image_and_its_time(tmp_path):
    # Equal images that follow each other are merged.
    images = [np.full((31, 45, 3), color, np.uint8) for color in COLORS]
    write_animation(tmp_path / "a.webp", images, 8)
    with Image.open(tmp_path / "a.webp") as file:
        assert (file.n_frames, file.size, file.info["loop"]) == (3, (45, 31), 0)
        for i, color in enumerate(COLORS):
            file.seek(i)
            shown = np.array(file.convert("RGB")).reshape(-1, 3).mean(axis=0)
            assert np.abs(shown - color).max() <= 6
            assert file.info["duration"] == 125


@pytest.mark.parametrize("suffix", ["mp4", "webp"])
def test_no_space_leaves_nothing_behind(tmp_path, suffix):
    def images():
        yield from IMAGES[:2]
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(DiskFullError, match=rf"a\.{suffix}: expected space"):
        write_animation(tmp_path / f"a.{suffix}", images(), 24)
    assert not list(tmp_path.iterdir())
