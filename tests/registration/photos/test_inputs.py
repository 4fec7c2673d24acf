"""Photos as the mapper gets them."""

import hashlib
import io
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from chronoscene.geodesy import Georeference
from chronoscene.images.decoding import load_rgb
from chronoscene.images.exif import read_exif
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.photos import inputs
from chronoscene.registration.photos.captures import Captures, read_captures
from chronoscene.registration.photos.gps_priors import locate
from chronoscene.registration.photos.photo import Capture, Gps
from chronoscene.registration.result import ANOTHER_PLACE
from chronoscene.scene import WorldFrame


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


def test_photos_that_colmap_does_not_read_become_png(folder: Path, tmp_path: Path) -> None:
    save(folder / "web.webp", 0, lossless=True)
    save(folder / "named.jpg", 1, format="WEBP")
    captures = read_captures(folder).images
    names, _ = inputs.place_photos(captures, tmp_path / "photos")
    assert names == ["named.jpg.png", "web.webp.png"]
    for capture, name in zip(captures, names, strict=True):
        placed = tmp_path / "photos" / name
        assert np.array_equal(load_rgb(placed), load_rgb(capture.path))


def test_a_converted_photo_states_its_focal_length(folder: Path, tmp_path: Path) -> None:
    """COLMAP would begin with that of a wide lens: 1.2 times the width."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Maker", 6
    exif.get_ifd(0x8769).update({0x920A: 8.8, 0xA405: 24, 0xA20E: 200.0, 0xA210: 3})
    save(folder / "web.webp", 0, exif=exif)
    captures = read_captures(folder).images
    inputs.place_photos(captures, tmp_path / "photos")
    placed = read_exif(tmp_path / "photos/web.webp.png")
    assert placed == replace(captures[0].exif, orientation=1)
    assert (placed.focal_mm, placed.focal_35mm, placed.focal_plane) == (8.8, 24, 20.0)
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, tmp_path / "photos", image_names=["web.webp.png"])
    with pycolmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
    diagonal = math.hypot(camera.width, camera.height)
    assert camera.has_prior_focal_length
    assert camera.mean_focal_length() == pytest.approx(24 / 43.27 * diagonal, rel=0.01)


def test_the_size_of_a_turned_tiff_is_that_of_its_pixels(folder: Path) -> None:
    """Clicks are checked by it, calibrations scaled, and cameras told apart."""
    exif = Image.Exif()
    exif[0x0112] = 6
    save(folder / "turned.tif", 0, exif=exif)
    (capture,) = read_captures(folder).images
    assert (capture.width, capture.height) == (96, 72)


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


def test_the_same_picture_saved_again_is_no_photo_of_another_date(folder: Path) -> None:
    for name, seed in (("0/a.jpg", 0), ("0/b.jpg", 1), ("1/own.jpg", 2)):
        save(folder / name, seed)
        with Image.open(folder / name) as image:  # photos are smoother than noise
            large = image.resize((960, 720), Image.Resampling.BICUBIC)
        large.save(folder / name, quality=95)
    with Image.open(folder / "0/a.jpg") as image:
        image.resize((800, 600)).save(folder / "1/smaller.png")
    with Image.open(folder / "0/b.jpg") as image:
        image.save(folder / "1/worse.jpg", quality=60)
    kept, refused, remarks = inputs.drop_saved_again(read_captures(folder).images)
    assert [c.name for c in kept] == ["0/a.jpg", "0/b.jpg", "1/own.jpg"]
    assert [(name, period) for name, period, _ in refused] == [
        ("1/smaller.png", 1),
        ("1/worse.jpg", 1),
    ]
    assert "the same picture as 0/a.jpg, saved again" in refused[0][2]
    assert remarks == ["pictures of an earlier period, saved again: 2"]


def gathered(images: tuple[Capture, ...], captures: Captures) -> inputs.PhotoInputs:
    return inputs.PhotoInputs(
        captures=captures,
        scene=None,
        images=images,
        periods={c.name: c.period for c in images},
        labels=("before", "after"),
        dates=tuple(p.date for p in captures.periods),
        refused={},
        positions=locate(images),
        georeference=None,
    )


def placed(capture: Capture, latitude: float) -> Capture:
    number = int(capture.path.stem)
    gps = Gps(latitude, 11.0 + 1e-4 * number, 100.0, None, (5.0, 5.0, 10.0))
    return replace(capture, gps=gps)


def test_a_period_of_another_place_is_said_to_be_one(folder: Path) -> None:
    for i in range(8):
        save(folder / ("before", "after")[i // 4] / f"{i}.jpg", i)
    captures = read_captures(folder)
    near = tuple(placed(c, 51.0 + 1e-3 * c.period) for c in captures.images)
    assert gathered(near, captures).far() == {}
    apart = tuple(placed(c, 51.0 + 20.0 * c.period) for c in captures.images)
    found = gathered(apart, captures).far()
    assert {name.split("/")[0] for name in found} == {"before"}  # it comes second
    assert next(iter(found.values())).startswith("2,217 km")
    assert next(iter(found.values())).endswith(ANOTHER_PLACE)


def test_photos_without_heights_are_not_far_below_a_scene(folder: Path) -> None:
    for i in range(4):
        save(folder / f"{i}.jpg", i)
    captures = read_captures(folder)
    flat = [placed(c, 51.0) for c in captures.images]
    images = tuple(replace(c, gps=replace(c.gps, altitude=None)) for c in flat if c.gps)
    frame = Georeference(51.0, 11.0, 2500.0, height_kind="as stated")
    scene: Any = SimpleNamespace()
    found = replace(gathered(images, captures), scene=scene, georeference=frame)
    assert replace(found, positions=locate(images, frame)).far() == {}


def test_new_photos_have_names_that_the_scene_lacks_once_they_are_placed(
    folder: Path, tmp_path: Path
) -> None:
    save(folder / "site A/0.jpg", 0)
    save(folder / "site A/1.jpg", 1)
    save(folder / "site A/2.tif", 2, mode="RGBA")
    frames = [SimpleNamespace(name=name) for name in ("site_A/0.jpg", "site_A/2.tif.png")]
    scene: Any = SimpleNamespace(frames=frames, num_periods=1)
    new = inputs._as_new_period(read_captures(folder).images, scene, "later")
    names, _ = inputs.place_photos(new, tmp_path / "photos")
    assert names == ["new/site_A/0.jpg", "site_A/1.jpg", "new/site_A/2.tif.png"]


def test_the_first_stage_depends_on_the_images_of_a_scene_that_is_extended(folder: Path) -> None:
    for name in ("captures/0.jpg", "old/1.jpg"):
        save(folder / name, len(name))
    captures = read_captures(folder / "captures")
    scene: Any = SimpleNamespace(
        root=folder / "old", frames=(SimpleNamespace(name="1.jpg"),), num_periods=1, masks={},
        periods=(SimpleNamespace(label="old", date=None),), world=WorldFrame(),
        image_path=lambda frame: folder / "old" / frame.name,
    )  # fmt: skip
    scene.frames[0].period = 0
    seen: list[Any] = []

    def run(_: str, depends_on: Any, __: object) -> list[str]:
        seen.append(depends_on)
        return ["captures/0.jpg"]

    context: Any = SimpleNamespace(stages=SimpleNamespace(run=run, remark=lambda *_: None))
    inputs.gather(captures, scene, context)
    inputs.gather(captures, scene, context)
    assert seen[0] == seen[1]
    save(folder / "old/1.jpg", 99)
    inputs.gather(captures, scene, context)
    assert seen[2] != seen[1]


@pytest.mark.parametrize("offset", [0.0, 500.0])
def test_positions_are_in_the_frame_of_a_scene_unless_it_has_an_offset(
    folder: Path, offset: float
) -> None:
    for i in range(4):
        save(folder / f"{i}.jpg", i)
    images = tuple(placed(c, 51.0) for c in read_captures(folder).images)
    frame = Georeference(51.001, 11.0, 90.0, "as stated")
    (folder / "georeference.json").write_text('{"height_kind": "relative"}')
    world = WorldFrame("metre", frame.crs, (offset, 0.0, 0.0))
    scene: Any = SimpleNamespace(root=folder, world=world)
    context: Any = SimpleNamespace(stages=SimpleNamespace(remark=lambda *_: None))
    positions, georeference = inputs._locate(images, scene, context)
    assert georeference == (None if offset else replace(frame, height_kind="relative"))
    middle = np.median(positions.enu[:, 1])
    assert middle == pytest.approx(0.0 if offset else -111.25, abs=0.1)


def test_photos_that_are_not_registered_do_not_date_a_period(folder: Path) -> None:
    days = {
        "before/0.jpg": "2016:03:01",
        "before/1.jpg": "2016:03:01",
        "before/2.jpg": "2016:09:09",
    }
    for i, name in enumerate([*days, "after/3.jpg"]):
        exif = Image.Exif()
        if name in days:
            exif.get_ifd(0x8769)[0x9003] = f"{days[name]} 12:00:00"
        save(folder / name, i, exif=exif)
    captures = read_captures(folder)
    found = gathered(captures.images, captures)
    first = [p.label for p in captures.periods].index("before")
    assert found.dates_of(frozenset(c.name for c in captures.images))[first] == "2016"
    assert found.dates_of(frozenset({"before/0.jpg", "before/1.jpg"}))[first] == "2016-03-01"


def test_captures_that_become_one_period_have_the_date_that_they_share(folder: Path) -> None:
    for i, day in enumerate(("2020:05:01", "2020:05:03")):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = f"{day} 12:00:00"
        save(folder / f"shots/{i}.jpg", i, exif=exif)
        save(folder / f"2021-03/{i}.jpg", i)
    assert inputs._new_period(read_captures(folder / "shots")) == ("2020-05-01", "2020-05")
    assert inputs._new_period(read_captures(folder / "2021-03")) == ("2021-03", "2021-03")
