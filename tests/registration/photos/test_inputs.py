"""Photos as the mapper gets them."""

import hashlib
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chronoscene.registration.photos import inputs
from chronoscene.registration.photos.captures import read_captures


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "captures"


def save(path: Path, seed: int, *, mode: str = "RGB", **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (72, 96, 3), np.uint8)
    Image.fromarray(pixels).convert(mode).save(path, **options)  # type: ignore[arg-type]


def test_orientation_is_set_to_upright_without_touching_a_pixel(
    folder: Path, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x0110] = "camera"
    save(folder / "turned.jpg", 0, exif=exif, quality=90)
    save(folder / "plain.jpg", 1, quality=90)
    before = (folder / "turned.jpg").read_bytes()
    names, remarks = inputs.place_photos(read_captures(folder).images, tmp_path / "photos")
    assert names == ["plain.jpg", "turned.jpg"]
    assert "1 photos have an orientation tag" in remarks[0]
    assert (folder / "turned.jpg").read_bytes() == before
    with Image.open(tmp_path / "photos/turned.jpg") as new, Image.open(io.BytesIO(before)) as old:
        assert new.getexif()[0x0112] == 1
        assert new.getexif()[0x0110] == "camera"
        assert np.array_equal(np.asarray(new), np.asarray(old))
    assert (tmp_path / "photos/plain.jpg").is_symlink()


def test_files_without_plain_colours_become_png(folder: Path, tmp_path: Path) -> None:
    save(folder / "print.jpg", 0, mode="CMYK")
    save(folder / "clear.png", 1, mode="RGBA")
    captures = read_captures(folder).images
    names, remarks = inputs.place_photos(captures, tmp_path / "photos")
    assert names == ["clear.png.png", "print.jpg.png"]
    assert "2 files converted" in remarks[0]
    for name in names:
        with Image.open(tmp_path / "photos" / name) as image:
            assert image.mode == "RGB"
    assert [c.name for c in inputs.renamed(captures, names)] == names


def test_transparent_pixels_become_black_so_that_nothing_is_found_there(
    folder: Path, tmp_path: Path
) -> None:
    folder.mkdir()
    pixels = np.full((64, 64, 4), 200, np.uint8)
    pixels[:40, :, 3] = 0
    Image.fromarray(pixels).save(folder / "clear.png")
    (name,), _ = inputs.place_photos(read_captures(folder).images, tmp_path / "photos")
    with Image.open(tmp_path / "photos" / name) as image:
        assert np.asarray(image)[:, 0, 0].tolist() == [0] * 40 + [200] * 24


def test_blanks_in_names_are_replaced_and_names_stay_unique() -> None:
    names = ["t 1/a b.jpg", "t_1/a_b.jpg", "t 1/c.jpg"]
    assert inputs.plain_names(names) == ["t_1/a_b_2.jpg", "t_1/a_b.jpg", "t_1/c.jpg"]


def test_a_photo_belongs_to_one_period(folder: Path) -> None:
    save(folder / "0/a.jpg", 0)
    save(folder / "0/b.jpg", 1)
    save(folder / "1/copy.jpg", 0)
    save(folder / "1/own.jpg", 2)
    captures = read_captures(folder).images
    digests = {c.name: hashlib.sha256(c.path.read_bytes()).hexdigest() for c in captures}
    kept, refused, _ = inputs.drop_copies(captures, digests)
    assert [c.name for c in kept] == ["0/a.jpg", "0/b.jpg", "1/own.jpg"]
    ((name, period, reason),) = refused
    assert (name, period) == ("1/copy.jpg", 1)
    assert reason.startswith("the same file as 0/a.jpg in an earlier period")
