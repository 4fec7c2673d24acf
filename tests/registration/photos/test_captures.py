"""Finding photos, their periods, and reasons against some of them."""

import os
import re
import unicodedata
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import SceneError
from chronoscene.images.decoding import load_rgb
from chronoscene.registration.photos import captures as captures_module
from chronoscene.registration.photos import photo as photo_module
from chronoscene.registration.photos.captures import photos_of, read_captures
from chronoscene.registration.photos.inputs import place_photos


def photo(path: Path, *, size: tuple[int, int] = (96, 72), taken: str | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.effect_noise(size, 60).convert("RGB")
    exif = Image.Exif()
    if taken is not None:
        exif.get_ifd(0x8769)[0x9003] = taken
    image.save(path, exif=exif)
    return path


def test_folders_are_periods_ordered_by_the_dates_of_their_photos(tmp_path: Path) -> None:
    photo(tmp_path / "after" / "a.jpg", taken="2016:05:01 10:00:00")
    photo(tmp_path / "before" / "b.jpg", taken="2023:05:01 10:00:00")
    found = read_captures(tmp_path)
    assert [(p.label, p.date) for p in found.periods] == [
        ("after", "2016-05-01"),
        ("before", "2023-05-01"),
    ]
    assert [(c.name, c.period) for c in found.images] == [("after/a.jpg", 0), ("before/b.jpg", 1)]
    assert found.images[0].taken == datetime(2016, 5, 1, 10)


def test_folders_may_be_links(tmp_path: Path) -> None:
    photo(tmp_path / "disk" / "2023" / "b.jpg")
    photo(tmp_path / "site" / "2016" / "a.jpg")
    (tmp_path / "site" / "2023").symlink_to(tmp_path / "disk" / "2023")
    (tmp_path / "site" / "2016" / "up").symlink_to(tmp_path / "site")
    found = read_captures(tmp_path / "site")
    assert [c.name for c in found.images] == ["2016/a.jpg", "2023/b.jpg"]


def test_links_to_photos_that_are_missing_are_named(tmp_path: Path) -> None:
    for name in ("2016/a.jpg", "2016/b.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(tmp_path / "unmounted" / name)
    with pytest.raises(
        SceneError, match="found 2 links to photos that are missing, such as 2016/a"
    ):
        read_captures(tmp_path)
    (tmp_path / "2016/a.jpg").unlink()
    for name in ("2016/a.jpg", "2023/a.jpg"):
        photo(tmp_path / name)
    found = read_captures(tmp_path)
    assert [c.name for c in found.images] == ["2016/a.jpg", "2023/a.jpg"]
    assert found.notes[0].startswith("1 link to photos that are missing, such as 2016/b.jpg")
    assert photos_of(tmp_path, None) == [tmp_path / "2016/a.jpg", tmp_path / "2023/a.jpg"]


def test_photos_in_formats_that_are_not_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "2023").mkdir()
    (tmp_path / "2023" / "b.DNG").touch()
    with pytest.raises(SceneError, match=r"found 1 photo in formats that are not read \(.dng\)"):
        read_captures(tmp_path)
    (tmp_path / "2023" / "a.dng").touch()
    photo(tmp_path / "2023" / "a.jpg")
    for name in ("2023/c.jpg", "2016/c.jpg"):
        photo(tmp_path / name)
        (note,) = read_captures(tmp_path).notes
        assert note.startswith("1 photo in formats") and "2023/b.DNG" in note


def test_videos(tmp_path: Path) -> None:
    for name in ("2016/walk.MOV", "2023/walk.mp4"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    with pytest.raises(SceneError, match=r"2 videos, and no image files; .*ffmpeg -i 20.*walk"):
        read_captures(tmp_path)


@pytest.mark.parametrize("suffix", ["HEIC", "avif"])
def test_photos_of_phones(suffix: str, tmp_path: Path) -> None:
    if suffix == "HEIC":
        pytest.importorskip("pillow_heif").register_heif_opener()
    elif not captures_module.features.check("avif"):
        pytest.skip("this Pillow has no AVIF")
    root = tmp_path / "captures"
    for label, year in (("before", 2023), ("after", 2016)):
        photo(root / label / f"a.{suffix}", taken=f"{year}:05:01 10:00:00")
        photo(root / label / "b.jpg", taken=f"{year}:05:01 10:00:00")
        photo(root / label / f"b.{suffix}")
    found = read_captures(root)
    assert [p.label for p in found.periods] == ["after", "before"] and not found.notes
    names = [c.name for c in found.images]
    assert names == [f"{p}/{n}" for p in ("after", "before") for n in (f"a.{suffix}", "b.jpg")]
    placed, remarks = place_photos(found.images, tmp_path / "placed")
    assert placed[0] == f"after/a.{suffix}.png" and placed[1] == "after/b.jpg"
    assert remarks == ["2 files converted to PNG: COLMAP does not read them as they are"]
    pixels = load_rgb(tmp_path / "placed" / placed[0])
    np.testing.assert_array_equal(pixels, load_rgb(root / names[0]))


def test_without_the_package_for_photos_of_phones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (captures_module, photo_module):
        monkeypatch.setattr(module, "reads_heif", lambda: False)
    photo(tmp_path / "2016" / "a.jpg")
    photo(tmp_path / "2023" / "b.jpg")
    (tmp_path / "2023" / "c.heic").write_bytes(b"x")
    (note,) = read_captures(tmp_path).notes
    assert note.endswith("left out; pip install 'chronoscene[heic]', or convert them to JPEG")
    table = tmp_path / "periods.csv"
    table.write_text("image,period\n2016/a.jpg,0\n2023/c.heic,1\n")
    ((_, _, reason),) = read_captures(tmp_path, table=table).refused
    assert "HEIC photos are not read; pip install" in reason


def test_folders_without_dates_are_in_natural_order(tmp_path: Path) -> None:
    for label in ("t10", "t2", "t1"):
        photo(tmp_path / label / "x.png")
    assert [p.label for p in read_captures(tmp_path).periods] == ["t1", "t2", "t10"]


def test_one_folder_is_cut_where_weeks_pass(tmp_path: Path) -> None:
    for i, day in enumerate(("2016:09:01", "2016:09:03", "2017:01:10", "2017:01:11")):
        photo(tmp_path / f"{i}.jpg", taken=f"{day} 12:00:00")
    found = read_captures(tmp_path)
    assert [c.period for c in found.images] == [0, 0, 1, 1]
    assert [p.date for p in found.periods] == ["2016-09", "2017-01"]
    assert "proposed" in " ".join(found.remarks)


def test_weeks_count_from_one_photo_to_the_next(tmp_path: Path) -> None:
    """A visit may last longer than the gap that ends it: 10, 10, 13 and 14 days."""
    for i, day in enumerate(("09:01", "09:11", "09:21", "10:04", "10:18")):
        photo(tmp_path / f"{i}.jpg", taken=f"2016:{day} 12:00:00")
    assert [c.period for c in read_captures(tmp_path).images] == [0, 0, 0, 0, 1]


def test_an_undated_photo_does_not_turn_all_periods_into_one(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", taken="2016:09:01 12:00:00")
    photo(tmp_path / "b.jpg", taken="2019:09:01 12:00:00")
    photo(tmp_path / "c.jpg")
    found = read_captures(tmp_path)
    assert [(c.name, c.period) for c in found.images] == [("a.jpg", 0), ("b.jpg", 1)]
    (note,) = found.notes
    assert "photos that have no date, so their period is unknown: 1 (c.jpg)" in note
    assert "--table" in note and note in found.remarks


def test_undated_photos_of_one_visit_are_of_that_period(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", taken="2016:09:01 12:00:00")
    photo(tmp_path / "b.jpg")
    found = read_captures(tmp_path)
    assert len(found.periods) == 1 and len(found.images) == 2 and not found.notes


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({}, "without N or S"), ({1: "S", 3: "E", 9: "V"}, "that the receiver marked as void")],
)
def test_positions_that_are_not_used_are_said(
    tmp_path: Path, wrong: dict[int, str], said: str
) -> None:
    for name, more in (("2016/a.jpg", wrong), ("2023/b.jpg", {1: "S", 3: "E"})):
        exif = Image.Exif()
        exif[0x010F] = "Maker"
        exif.get_ifd(0x8825).update({2: (33, 51, 24.0), 4: (151, 12, 36.0)} | more)
        with Image.open(photo(tmp_path / name)) as image:
            image.save(tmp_path / name, exif=exif)
    found = read_captures(tmp_path)
    assert [c.gps is None for c in found.images] == [True, False]
    (note,) = found.notes
    assert note.startswith(f"1 of 2 photos, such as 2016/a.jpg, have a GPS position {said}")
    assert note in found.remarks


@pytest.mark.parametrize(
    ("names", "label"),
    [(("2016/a.jpg", "2016/east/b.jpg"), "2016"), (("a.jpg", "2016/b.jpg"), "old"),
     (("a.jpg",), "old")],
)  # fmt: skip
def test_undated_photos_are_of_the_period_that_their_folder_names(
    tmp_path: Path, names: tuple[str, ...], label: str
) -> None:
    for name in names:
        photo(tmp_path / "old" / name)
    assert [period.label for period in read_captures(tmp_path / "old").periods] == [label]


def test_a_stray_photo_does_not_hide_the_folders_of_the_periods(tmp_path: Path) -> None:
    for name in ("2016/a.jpg", "2023/b.jpg", "map.png"):
        photo(tmp_path / name)
    found = read_captures(tmp_path)
    assert [c.name for c in found.images] == ["2016/a.jpg", "2023/b.jpg"]
    assert [p.label for p in found.periods] == ["2016", "2023"]
    assert (
        "photos that lie beside the folders of the periods, so their period is unknown: 1 ("
        in found.notes[0]
    )
    assert "map.png" in found.notes[0]


def test_folders_with_fewer_photos_than_lie_beside_them_are_no_periods(tmp_path: Path) -> None:
    for name in ("x/a.jpg", "y/b.jpg", "1.jpg", "2.jpg", "3.jpg"):
        photo(tmp_path / name)
    assert len(read_captures(tmp_path).periods) == 1


def test_dates_in_file_names_count_where_exif_has_none(tmp_path: Path) -> None:
    photo(tmp_path / "20160901_a.jpg")
    photo(tmp_path / "2017-05-02_b.jpg")
    assert [p.date for p in read_captures(tmp_path).periods] == ["2016-09-01", "2017-05-02"]


def test_a_table_gives_periods(tmp_path: Path) -> None:
    photo(tmp_path / "images" / "a.jpg")
    photo(tmp_path / "images" / "b c.jpg")
    table = tmp_path / "periods.csv"
    table.write_text("file,period,lat\na.jpg,1,\nb c.jpg,0,\n")
    for captures in (read_captures(tmp_path, table=table), read_captures(table)):
        assert [(c.name, c.period) for c in captures.images] == [("a.jpg", 1), ("b c.jpg", 0)]


@pytest.mark.parametrize("folder", ["", "images"])
def test_a_table_may_have_names_in_another_unicode_form(tmp_path: Path, folder: str) -> None:
    name = unicodedata.normalize("NFD", "Süd/höhe.jpg")
    file = photo(tmp_path / folder / name)
    photo(tmp_path / folder / "b.jpg")
    table = tmp_path / "periods.csv"
    table.write_text(
        unicodedata.normalize("NFC", "image,period\nSüd/höhe.jpg,1\nb.jpg,0\n"), encoding="utf-8"
    )
    found = read_captures(table)
    assert (found.images[0].name, found.images[0].path) == (name, file)
    assert not found.refused
    table.write_text(table.read_text(encoding="utf-8") + f"{name},2\n", encoding="utf-8")
    with pytest.raises(SceneError, match="expected one period of 'Su"):
        read_captures(table)


def test_names_that_are_not_utf_8_are_refused(tmp_path: Path) -> None:
    """Archives of old programs have names in the encoding of their country."""
    photo(tmp_path / "a.jpg")
    photo(tmp_path / "0" / "b.jpg")
    photo(tmp_path / "1" / "c.jpg").rename(tmp_path / "1" / os.fsdecode(b"stra\xdfe.jpg"))
    place = re.escape(str(tmp_path))
    with pytest.raises(SceneError, match=rf"^{place}: expected image names in UTF-8, .*\\udcdf"):
        read_captures(tmp_path)
    photo(tmp_path / "1" / "c.jpg")
    (tmp_path / "1" / os.fsdecode(b"stra\xdfe.jpg")).rename(tmp_path / os.fsdecode(b"\xdf.jpg"))
    (tmp_path / "1" / os.fsdecode(b"\xdf.dng")).touch()
    notes = "".join(read_captures(tmp_path).notes)  # of photos that are left out
    assert notes.count("\\udcdf") == 2
    assert notes.isprintable()


def test_a_table_may_have_backslashes(tmp_path: Path) -> None:
    names = ["a.jpg", "2016/b.jpg", "2016/x\\y.jpg"]
    for name in names:
        photo(tmp_path / name)
    table = tmp_path / "periods.csv"
    table.write_text("image,period\n.\\a.jpg,0\n2016\\b.jpg,0\n2016/x\\y.jpg,0\n2016\\c.jpg,0\n")
    found = read_captures(table)
    assert [c.name for c in found.images] == sorted(names)
    assert [name for name, *_ in found.refused] == ["2016/c.jpg"]
    table.write_text("image,period\n..\\a.jpg,0\n")
    with pytest.raises(SceneError, match="below the folder of the captures"):
        read_captures(table)


@pytest.mark.parametrize(
    ("text", "place", "found"),
    [
        ("a.jpg,0\n", "t.csv", "a.jpg,0"),
        ("image,period\n,\n\n../x.jpg,0\n", "t.csv:4", "'../x.jpg'"),
        ("image,period\na.jpg,\n", "t.csv:2", "''"),
        ("image,period\na.jpg,0\na.jpg,1\n", "t.csv:3", "'0' and '1'"),
        ("image,period\na.jpg,0\n./a.jpg,1\n", "t.csv:3", "'0' and '1'"),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, text: str, place: str, found: str) -> None:
    photo(tmp_path / "a.jpg")
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(SceneError) as caught:
        read_captures(tmp_path, table=tmp_path / "t.csv")
    assert place in caught.value.place
    assert found in caught.value.found


def test_missing_and_unusable_photos_of_a_table_are_named_with_their_rows(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg")
    (tmp_path / "text.jpg").write_text("no photo")
    table = tmp_path / "t.csv"
    table.write_text("image,period\na.jpg,0\n\nsub/b.jpg,0\ntext.jpg,0\n")
    missing, text = read_captures(tmp_path, table=table).refused
    assert missing == ("sub/b.jpg", 0, "t.csv:4: the file is missing")
    assert text[2].startswith("t.csv:5: cannot be decoded: ")
    table.write_text("image,period\nb.jpg,0\n")
    with pytest.raises(SceneError, match=r"1 files, none usable \(t.csv:2: the file is missing\)"):
        read_captures(tmp_path, table=table)


def test_unusable_photos_are_named_with_reasons(tmp_path: Path) -> None:
    photo(tmp_path / "0" / "good.jpg")
    photo(tmp_path / "1" / "good.jpg")
    whole = photo(tmp_path / "1" / "cut.jpg").read_bytes()
    (tmp_path / "1" / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "1" / "text.jpg").write_text("no photo")
    photo(tmp_path / "1" / "icon.png", size=(32, 32))
    photo(tmp_path / "1" / "panorama.jpg", size=(400, 100))
    xmp = b'<x:xmpmeta GPano:ProjectionType="equirectangular"/>'
    Image.effect_noise((200, 100), 60).save(tmp_path / "1" / "sphere.jpg", xmp=xmp)
    found = read_captures(tmp_path)
    assert [c.name for c in found.images] == ["0/good.jpg", "1/good.jpg"]
    reasons = {name: reason for name, _, reason in found.refused}
    assert reasons["1/cut.jpg"].startswith("cannot be decoded")
    assert reasons["1/text.jpg"].startswith("cannot be decoded")
    assert reasons["1/icon.png"].endswith("too small")
    assert "panorama" in reasons["1/panorama.jpg"]
    assert "panorama" in reasons["1/sphere.jpg"]


def test_masks_lie_beside_the_folder_of_the_photos(tmp_path: Path) -> None:
    for name in ("images/2016/a.jpg", "images/2023/b.jpg"):
        photo(tmp_path / name)
    mask = tmp_path / "masks/2016/a.jpg.png"
    mask.parent.mkdir(parents=True)
    mask.touch()
    assert [c.mask for c in read_captures(tmp_path / "images").images] == [mask, None]
    (tmp_path / "images/periods.csv").write_text("image,period\n2016/a.jpg,one\n2023/b.jpg,two\n")
    masks = [c.mask for c in read_captures(tmp_path / "images/periods.csv").images]
    assert masks == [mask, None]


@pytest.mark.parametrize("place", ["", "all"])
def test_masks_among_the_photos_are_no_photos(tmp_path: Path, place: str) -> None:
    for name in ("2016/a.jpg", "2023/b.jpg"):
        photo(tmp_path / place / name)
    mask = photo(tmp_path / "masks" / place / "2016/a.jpg.png")
    found = read_captures(tmp_path)
    assert [c.mask for c in found.images] == [mask, None]
    assert not found.notes


def test_masks_without_photos_are_named(tmp_path: Path) -> None:
    for name in ("images/2016/a.jpg", "images/2023/b.jpg", "masks/2016/a.png"):
        photo(tmp_path / name)
    (note,) = read_captures(tmp_path / "images").notes
    would = "no mask in {}/masks is used: that of 2016/a.jpg would be masks/2016/a.jpg.png"
    assert note == would.format(tmp_path)


def test_nothing_to_register_is_said(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="found no image files"):
        read_captures(tmp_path)
    with pytest.raises(SceneError, match="found nothing"):
        read_captures(tmp_path / "absent")
    (tmp_path / "x.jpg").write_text("no photo")
    with pytest.raises(SceneError, match=r"1 files, none usable \(cannot be decoded"):
        read_captures(tmp_path)


@pytest.mark.parametrize(
    ("photos", "named", "dates"),
    [
        ({"2016": ("2016:03:01", "2018:05:03")}, ["2016/1.jpg: 2018-05-03"], ["2016-03-01"]),
        ({"2016-03": ("2018:05:03",) * 2}, ["2 of 2", "2016-03/0.jpg"], ["2016-03"]),
        ({"2016-03-01": ("2016:03:01", "2016:03:04")}, [], ["2016-03"]),
        ({"2022-05-01": ("2022:05:01", "2022:05:11"), "2022-05-11": ("2022:05:11",)},
         ["2022-05-01/1.jpg"], ["2022-05-01", "2022-05-11"]),
        ({"before": ("2016:03:01",) * 4 + ("2018:05:03",), "after": ("2018:05:03",) * 2},
         ["before/4.jpg"], ["2016-03-01", "2018-05-03"]),
        ({"before": ("2016:03:01", "2016:09:01"), "after": ("2016:06:01",) * 2}, [], None),
    ],
)  # fmt: skip
def test_photos_whose_date_contradicts_their_period_are_named(
    tmp_path: Path, photos: dict[str, tuple[str, ...]], named: list[str], dates: list[str] | None
) -> None:
    for label, days in (photos | {"2030": ()}).items():
        photo(tmp_path / label / "undated.jpg")
        for i, day in enumerate(days):
            photo(tmp_path / label / f"{i}.jpg", taken=f"{day} 10:00:00")
    found = read_captures(tmp_path)
    assert bool(found.misdated) == bool(named)
    assert all(words in found.misdated[0] for words in named)
    assert set(found.misdated) <= set(found.remarks)
    if dates is not None:
        known = {p.label: p.date for p in found.periods}
        assert [known[label] for label in photos] == dates
