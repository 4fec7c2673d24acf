"""Images one after the other, as a file that plays."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.io.staging import replacing

SUFFIXES = (".mp4", ".webp")
WEBP_SIDE = 16383
"""Largest width and height of WebP, in pixels."""

_BT709 = 1  # Its number in the tables of H.264
_CRF = "18"  # Of x264: hardly visible
_WEBP_QUALITY = 70


def write_animation(path: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write images of one size as H.264 in MP4, or as animated WebP, which goes on for ever.

    Args:
        path: Ends in one of `SUFFIXES`. The file appears complete or not at all.
        images: At least one; MP4 repeats the last row or column where a side is odd. [H, W, 3]
        fps: Images per second.

    Raises:
        DiskFullError: If there is no space for it.
    """
    write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_webp
    with replacing(path) as partial:
        write(partial, images, fps)


def _write_mp4(path: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> None:
    import av

    options = {"movflags": "+faststart"}  # plays while it loads
    with av.open(str(path), "w", format="mp4", options=options) as container:
        rest = iter(images)
        first = next(rest)
        rate = Fraction(fps).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=rate, options={"crf": _CRF})
        stream.height, stream.width = (side + side % 2 for side in first.shape[:2])
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        for image in chain([first], rest):
            even = np.pad(image, [(0, side % 2) for side in image.shape[:2]] + [(0, 0)], "edge")
            frame = av.VideoFrame.from_ndarray(even, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))
        container.mux(stream.encode(None))


def _write_webp(path: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> None:
    first, *rest = (Image.fromarray(image) for image in images)
    options = {"duration": 1000 / fps, "loop": 0, "quality": _WEBP_QUALITY, "method": 6}
    first.save(path, format="webp", save_all=True, append_images=rest, **options)
