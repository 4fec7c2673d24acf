import io

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.folder.pixels import has_end, jpeg_damage


def jpeg(**options):
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 256, (60, 80, 3), np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).resize((320, 240)).save(file, "JPEG", quality=90, **options)
    return file.getvalue()


WHOLE = {
    "baseline": {},
    "progressive": {"progressive": True},
    "optimised": {"optimize": True},
    "restarts": {"restart_marker_blocks": 4},
    "subsampled": {"subsampling": 2},
}


@pytest.mark.parametrize("kind", WHOLE)
@pytest.mark.parametrize("behind", [b"", b"\0" * 9000, b"phone data" * 900])
def test_whole_files_are_whole(kind, behind):
    data = jpeg(**WHOLE[kind]) + behind
    assert jpeg_damage(data) is None and has_end(data)


def test_a_preview_in_front_is_not_the_image():
    exif = Image.Exif()
    exif[0x010F] = "Maker\xff\xd9"
    data = jpeg(exif=exif.tobytes() + b"\xff\xd8\xff\xd9")
    assert has_end(data) and not has_end(data[: len(data) // 2])


@pytest.mark.parametrize("kind", WHOLE)
@pytest.mark.parametrize("filler", [b"\0", b"\xaa"])
def test_a_file_that_was_filled_up_is_damaged(kind, filler):
    data = jpeg(**WHOLE[kind])
    half = len(data) // 2
    damage = jpeg_damage(data[:half] + filler * (len(data) - half))
    assert damage is not None and "no end of the image" in damage


def test_foreign_bytes_in_the_middle():
    data = bytearray(jpeg())
    half = len(data) // 2
    data[half : half + 4] = b"\x12\xff\x3c\x56"
    assert (
        jpeg_damage(bytes(data)) == f"compressed data with an impossible marker at byte {half + 1}"
    )


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0", b"\xff\xd8\xff\xff\xff", b"x"]
)
def test_what_is_no_jpeg_is_left_to_the_decoder(data):
    assert jpeg_damage(data) is None and not has_end(data)
