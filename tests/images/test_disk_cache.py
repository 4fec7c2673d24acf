"""Decoded photos on disk: equal to decoding, bounded, and safe whatever happens to the folder."""

import errno
import io
import os
import random
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import ImageError
from chronoscene.images import disk_cache
from chronoscene.images.decoding import load_photo
from chronoscene.images.disk_cache import DiskCache

SIZE = (12, 9)


def file_bytes():
    """Size of the file of a photo without a mask."""
    np.savez(
        buffer := io.BytesIO(), image=np.zeros((9, 12, 3), np.uint8), mask=np.zeros((0, 0), bool)
    )
    return buffer.tell()


FILE_BYTES = file_bytes()


@pytest.fixture
def photos(tmp_path):
    """Six photos, the first with a mask."""
    rng = np.random.default_rng(0)
    for i in range(6):
        pixels = rng.integers(0, 256, (18, 24, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{i}.png")
    mask = np.full((18, 24), 255, np.uint8)
    mask[:8] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    return [(tmp_path / f"{i}.png", None if i else tmp_path / "mask.png") for i in range(6)]


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "runs" / "photos"


@pytest.fixture
def decoded(monkeypatch):
    """Names of the files that were decoded."""
    names = []

    def load(path, *args, **options):
        names.append(path.name)
        return load_photo(path, *args, **options)

    monkeypatch.setattr(disk_cache, "load_photo", load)
    return names


def assert_right(cache, place, size=SIZE):
    for found, expected in zip(
        cache.load(*place, size=size), load_photo(*place, size=size), strict=True
    ):
        np.testing.assert_array_equal(found, expected)
        assert found is None or found.dtype == expected.dtype


def files_of(folder):
    return {path.name: path.stat().st_size for path in folder.iterdir()}


def test_the_second_time_nothing_is_decoded(photos, folder, decoded):
    for _ in range(2):
        for place in photos:
            assert_right(DiskCache(folder, 10**6), place)
    assert decoded == [f"{i}.png" for i in range(6)]
    assert len(files_of(folder)) == 6 and FILE_BYTES in files_of(folder).values()


def test_content_and_size_decide_and_names_do_not(photos, folder, decoded):
    (first, mask), (second, _) = photos[:2]
    assert_right(DiskCache(folder, 10**6), (first, mask))
    shutil.copy(first, first.with_name("copy.png"))
    assert_right(DiskCache(folder, 10**6), (first.with_name("copy.png"), mask))
    assert decoded == ["0.png"]
    assert_right(DiskCache(folder, 10**6), (first, None))
    assert_right(DiskCache(folder, 10**6), (first, mask), (6, 4))
    shutil.copy(second, first)
    assert_right(DiskCache(folder, 10**6), (first, mask))
    Image.new("L", (24, 18), 0).save(mask)
    assert_right(DiskCache(folder, 10**6), (first, mask))
    assert decoded == ["0.png"] * 5


def test_a_newer_decoder_decodes_again(photos, folder, decoded, monkeypatch):
    assert_right(DiskCache(folder, 10**6), photos[0])
    monkeypatch.setattr("PIL.__version__", "99")
    assert_right(DiskCache(folder, 10**6), photos[0])
    assert decoded == ["0.png"] * 2


def test_damage_is_noticed_and_mended(photos, folder):
    assert_right(DiskCache(folder, 10**6), photos[0])
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    rng = random.Random(0)
    for _ in range(150):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        file.write_bytes(data if rng.random() < 0.8 else data[: rng.randrange(len(data))])
        assert_right(DiskCache(folder, 10**6), photos[0])
    assert_right(DiskCache(folder, 10**6), photos[0])
    assert file.read_bytes() == whole


def test_the_oldest_leave_and_those_in_use_stay(photos, folder, decoded):
    limit = 4 * (FILE_BYTES + 2048)
    before = DiskCache(folder, limit)
    for place in photos[1:5]:
        before.load(*place, size=SIZE)
    names = sorted(folder.iterdir(), key=os.path.getmtime)
    for age, path in enumerate(names):
        os.utime(path, (1000 + age, 1000 + age))
    now = DiskCache(folder, 4 * FILE_BYTES + 2048)
    now.load(*photos[1], size=SIZE)  # the oldest, which is in use now
    now._made -= 10  # a coarse clock of the disk must not decide this test
    now.load(*photos[5], size=SIZE)
    assert names[0].exists() and not names[1].exists() and names[2].exists()
    for place in photos[1:4]:
        now.load(*place, size=SIZE)  # all in use; the one that left comes back for the last
    assert sum(files_of(folder).values()) <= 4 * FILE_BYTES + 2048
    decoded.clear()
    again = DiskCache(folder, 4 * FILE_BYTES + 2048)
    again._made = 0.0  # so that all files count as in use
    again.load(*photos[4], size=SIZE)
    assert decoded == ["4.png"] and len(files_of(folder)) == 4


def test_leftovers_of_killed_processes_count_and_go(photos, folder):
    folder.mkdir(parents=True)
    leftover = folder / ".x.npz.1.partial"
    leftover.write_bytes(b"0" * FILE_BYTES)
    os.utime(leftover, (1000, 1000))
    DiskCache(folder, FILE_BYTES + 2048).load(*photos[1], size=SIZE)
    assert not leftover.exists() and len(files_of(folder)) == 1


def test_no_room_at_all_only_costs_time(photos, folder, decoded):
    cache = DiskCache(folder, 100)
    for _ in range(2):
        assert_right(cache, photos[0])
    assert decoded == ["0.png"] * 2 and not files_of(folder)


def test_a_full_disk_only_costs_time(photos, folder, monkeypatch):
    def full(*args, **options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    assert_right(DiskCache(folder, 10**6), photos[0])
    assert not files_of(folder)


def test_missing_and_damaged_photos_are_errors_as_without_a_cache(photos, folder):
    cache = DiskCache(folder, 10**6)
    with pytest.raises(ImageError, match=r"x\.png: expected an image, found nothing"):
        cache.load(photos[0][0].with_name("x.png"), None, size=SIZE)
    photos[1][0].write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"1\.png: expected an image that can be decoded"):
        cache.load(*photos[1], size=SIZE)
    assert not folder.exists()


def test_equal_photos_in_many_threads(photos, folder):
    copies = [(shutil.copy(photos[1][0], folder.parents[1] / f"c{i}.png"), None) for i in range(8)]
    cache, start = DiskCache(folder, 10**6), threading.Barrier(8)

    def work(place):
        start.wait()
        return cache.load(*place, size=SIZE)[0]

    with ThreadPoolExecutor(8) as pool:
        for image in pool.map(work, copies):
            np.testing.assert_array_equal(image, load_photo(photos[1][0], size=SIZE)[0])
    assert list(files_of(folder).values()) == [FILE_BYTES]


PROCESS = """
import random, shutil, sys
from pathlib import Path
import numpy as np
from chronoscene.images.decoding import load_photo
from chronoscene.images.disk_cache import DiskCache
folder, seed, limit, *paths = sys.argv[1:]
rng = random.Random(int(seed))
truth = {path: load_photo(Path(path), size=(12, 9))[0] for path in paths}
for _ in range(60):
    cache = DiskCache(Path(folder), int(limit))
    for path in rng.sample(paths, 4):
        assert (cache.load(Path(path), None, size=(12, 9))[0] == truth[path]).all()
    if rng.random() < 0.1:
        shutil.rmtree(folder, ignore_errors=True)
"""


def test_several_processes_and_deletion_in_between(photos, folder):
    paths = [str(path) for path, _ in photos]
    limit = str(3 * FILE_BYTES + 2048)
    command = [sys.executable, "-c", PROCESS, str(folder)]
    workers = [subprocess.Popen([*command, str(seed), limit, *paths]) for seed in range(3)]
    assert [worker.wait(120) for worker in workers] == [0, 0, 0]
