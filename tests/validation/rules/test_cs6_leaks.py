import io
import shutil

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.folder.pixels import Pixels
from chronoscene.validation.rules.cs6_leaks import near_pairs, twins

TEST = "sparse/0/test.txt"


def copy_bytes(scene, source, target):
    shutil.copyfile(scene.path(f"images/{source}"), scene.path(f"images/{target}"))


def copy_pixels(scene, source, target):
    """The same pixels in a file of other bytes."""
    Image.open(scene.path(f"images/{source}")).save(
        scene.path(f"images/{target}"), compress_level=0
    )


def copy_through_jpeg(scene, source, target):
    """Nearly the same pixels."""
    smooth = Image.open(scene.path(f"images/{source}")).resize((8, 6)).resize((64, 48))
    smooth.save(scene.path(f"images/{source}"))
    smooth.save(file := io.BytesIO(), "JPEG", quality=80)
    Image.open(file).save(scene.path(f"images/{target}"))


def test_equal_files_in_train_and_test(scene):
    copy_bytes(scene, "a000.png", "a003.png")
    scene.expect("CS601", place="images/a003.png", found="the same bytes in training: 'a000.png'")


def test_equal_pixels_in_train_and_test_need_decoding(scene):
    copy_pixels(scene, "a000.png", "a003.png")
    assert {f.code for f in scene.validate().findings} == {"CS507"}
    found = "the same pixels in training: 'a000.png'"
    scene.expect("CS601", place="images/a003.png", found=found, decode=True)


@pytest.mark.parametrize(("copy", "kind"), [(copy_bytes, "bytes"), (copy_pixels, "pixels")])
def test_one_photo_in_two_periods(scene, copy, kind):
    copy(scene, "a000.png", "b000.png")
    found = f"the same {kind} in periods 0 and 1: 'a000.png', 'b000.png'"
    scene.expect("CS602", place="images/a000.png", found=found, decode=True)


def test_one_photo_in_both_ways(scene):
    copy_bytes(scene, "a000.png", "b003.png")
    scene.expect("CS601", place="images/b003.png", also={"CS602"})


def test_one_photo_twice(scene):
    copy_bytes(scene, "a000.png", "a001.png")
    scene.expect("CS603", place="images/a000.png", found="the same bytes in 'a001.png'")


@pytest.mark.parametrize("target", ["a003.png", "b000.png"])
def test_photo_saved_again(scene, target):
    copy_through_jpeg(scene, "a000.png", target)
    assert {f.code for f in scene.validate().findings} == {"CS507"}
    scene.expect("CS604", found="grey levels from that of", decode=True)


def test_good_scene_is_silent_when_decoded(scene):
    report = scene.validate(decode=True)
    assert {f.code for f in report.findings} == {"CS507"}
    assert not report.skipped


def test_near_pairs_over_blocks_of_rows():
    rng = np.random.default_rng(0)
    pixels = {}
    for i in range(600):
        thumbnail = rng.uniform(0, 255, (32, 32, 3)).astype(np.float32)
        pixels[f"{i:03d}"] = Pixels(None, bytes([i // 256, i % 256]), thumbnail)
    for a, b in ((3, 4), (10, 590), (300, 599)):
        near = pixels[f"{a:03d}"].thumbnail + np.float32(0.5)
        pixels[f"{b:03d}"] = Pixels(None, pixels[f"{b:03d}"].digest, near)
    role = {name: i % 2 for i, name in enumerate(pixels)}
    role["590"] = role["299"] = 2
    found = sorted(near_pairs(pixels, role))
    assert [(a, b) for a, b, _ in found] == [("003", "004"), ("010", "590"), ("300", "599")]
    assert [d for *_, d in found] == pytest.approx([0.5] * 3, abs=1e-3)


def test_featureless_images_are_not_compared():
    grey = np.full((32, 32, 3), 128, np.float32)
    pixels = {n: Pixels(None, n.encode(), grey + i) for i, n in enumerate("ab")}
    assert list(near_pairs(pixels, {"a": 0, "b": 1})) == []


def test_saved_twice_is_not_equal_bytes():
    image = Image.fromarray(np.zeros((4, 4, 3), np.uint8))
    files = []
    for level in (0, 9):
        image.save(file := io.BytesIO(), "PNG", compress_level=level)
        files.append(file.getvalue())
    assert files[0] != files[1]  # or the tests above would test nothing


def test_test_image_with_the_pose_of_a_training_image(scene):
    lines = scene.lines("sparse/0/images.txt")
    pose = lines[0].split()[1:8]
    words = lines[6].split()
    lines[6] = " ".join([words[0], *pose, *words[8:]])
    lines[7] = lines[1]
    scene.write("sparse/0/images.txt", lines)
    scene.expect("CS605", place="(a003.png)", found="the pose of 'a000.png'")


def test_one_pose_in_two_periods_is_a_tripod(scene):
    lines = scene.lines("sparse/0/images.txt")
    words = lines[24].split()
    lines[24] = " ".join([words[0], *lines[0].split()[1:8], *words[8:]])
    lines[25] = lines[1]
    scene.write("sparse/0/images.txt", lines)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_twins_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    places, periods = rng.uniform(size=(300, 3)), rng.integers(-1, 3, 300)
    test = rng.random(300) < 0.3
    rotations = np.where(rng.random((300, 1, 1)) < 0.5, np.eye(3), -np.eye(3))
    near = np.linalg.norm(places[:, None] - places, axis=2) <= 0.2
    near &= (rotations[:, None] == rotations).all(axis=(2, 3))
    near &= (periods[:, None] == periods) & (periods >= 0) & test[:, None] & ~test
    found = dict(twins(places, rotations, periods, test, near=0.2))
    assert sorted(found) == np.flatnonzero(near.any(axis=1)).tolist()
    assert all(near[i, j] for i, j in found.items()) and len(found) > 10


def test_a_fixed_camera_gives_one_pair_for_each_image():
    noise = np.random.default_rng(0).uniform(0, 255, (32, 32, 3)).astype(np.float32)
    pixels = {f"{i}": Pixels(None, bytes([i]), noise + i / 100) for i in range(200)}
    pairs = list(near_pairs(pixels, {name: int(name) % 2 for name in pixels}))
    assert len(pairs) == 199
