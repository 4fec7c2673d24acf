"""Image folders: names stay inside, bytes are proven, quantisation is rounding."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.errors import CheckpointError
from chronoscene.harness.files.predictions import (
    ImageWriter,
    image_file,
    load_image,
    load_mask,
    read_manifest,
    safe_name,
    to_bytes,
)

IMAGE = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path):
    writer = ImageWriter(tmp_path / "images")
    writer.add("b/2016/x.jpg", IMAGE, camera_period=1, rendered_period=1)
    writer.add("a.png", IMAGE[::-1], camera_period=0, rendered_period=0)
    writer.close(kind="predictions", scene="s", scene_hash="h", details={"max_width": 7})
    return tmp_path / "images"


def edit(folder, change):
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_what_is_written_is_read(folder):
    manifest = read_manifest(folder)
    assert [e.view for e in manifest.images] == ["a.png", "b/2016/x.jpg"]
    assert [e.file for e in manifest.images] == ["a.png.png", "b/2016/x.jpg.png"]
    np.testing.assert_array_equal(load_image(folder, manifest.images[0]), IMAGE[::-1])
    np.testing.assert_array_equal(load_image(folder, manifest.images[1]), IMAGE)


def test_masks_lie_beside_their_photos_with_their_hash(tmp_path):
    writer, mask = ImageWriter(tmp_path), IMAGE[..., 0] > 99
    writer.add("b/x.jpg", IMAGE, camera_period=0, rendered_period=0, mask=mask)
    writer.add("a.png", IMAGE, camera_period=0, rendered_period=0)
    writer.close(kind="ground truth", scene="s", scene_hash="h", details={})
    plain, masked = read_manifest(tmp_path).images
    assert load_mask(tmp_path, plain) is None
    np.testing.assert_array_equal(load_mask(tmp_path, masked), mask)
    np.testing.assert_array_equal(load_image(tmp_path, masked), IMAGE)
    (tmp_path / "b/x.jpg.mask.png").write_bytes((tmp_path / "a.png.png").read_bytes())
    with pytest.raises(CheckpointError, match=r"mask\.png: .* found another file"):
        load_mask(tmp_path, masked)
    edit(tmp_path, lambda d: d["images"][1].update(mask_file="../x.png"))
    with pytest.raises(CheckpointError, match="leads outside"):
        read_manifest(tmp_path)


def test_equal_images_give_equal_bytes(folder, tmp_path):
    writer = ImageWriter(tmp_path / "again")
    writer.add("a.png", IMAGE[::-1], camera_period=0, rendered_period=0)
    assert (tmp_path / "again/a.png.png").read_bytes() == (folder / "a.png.png").read_bytes()


def test_floats_are_rounded_and_clipped():
    values = np.array([-1.0, 0.0, 0.4 / 255, 0.6 / 255, 1.0, 2.0]).reshape(1, 2, 3)
    assert to_bytes(values).ravel().tolist() == [0, 0, 0, 1, 255, 255]


@pytest.mark.parametrize("view", ["../x.png", "/etc/x.png", "a/../../x.png", ""])
def test_views_cannot_leave_the_folder(tmp_path, view):
    writer = ImageWriter(tmp_path / "images")
    with pytest.raises(CheckpointError, match="a path that leads outside"):
        writer.add(view, IMAGE, camera_period=0, rendered_period=0)
    assert not list((tmp_path / "images").iterdir())


@given(st.text(min_size=1, max_size=20), st.text(min_size=1, max_size=20))
def test_safe_names_differ_where_names_do(a, b):
    assert (safe_name(a) == safe_name(b)) == (a == b)
    assert not set('<>:"|?*\\\0\n') & set(safe_name(a))


@given(st.text(min_size=1, max_size=30))
def test_image_files_stay_inside_or_are_refused(tmp_path_factory, view):
    root = tmp_path_factory.getbasetemp() / "inside"
    try:
        file = image_file(view)
    except CheckpointError:
        return
    assert (root / file).resolve().is_relative_to(root.resolve())


@pytest.mark.parametrize("path", ["../secret.png", "/etc/passwd", "..\\secret.png", ""])
def test_manifests_cannot_name_files_outside(folder, path):
    edit(folder, lambda d: d["images"][0].update(file=path))
    with pytest.raises(CheckpointError, match="leads outside"):
        read_manifest(folder)


def test_links_out_of_the_folder_are_refused(folder, tmp_path):
    target = folder / "a.png.png"
    target.rename(tmp_path / "outside.png")
    target.symlink_to(tmp_path / "outside.png")
    with pytest.raises(CheckpointError, match="no such file"):
        load_image(folder, read_manifest(folder).images[0])


def test_a_changed_image_is_refused(folder):
    path = folder / "a.png.png"
    path.write_bytes((folder / "b/2016/x.jpg.png").read_bytes())
    with pytest.raises(CheckpointError, match=r"SHA-256 .* found another file"):
        load_image(folder, read_manifest(folder).images[0])


def test_a_missing_image_is_named(folder):
    (folder / "a.png.png").unlink()
    with pytest.raises(CheckpointError, match=r"a\.png\.png: expected an image"):
        load_image(folder, read_manifest(folder).images[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format_version=2), "format_version"),
        (lambda d: d.update(kind="other"), "kind"),
        (lambda d: d.pop("scene_hash"), "scene_hash"),
        (lambda d: d["images"].append(d["images"][0]), "a view twice"),
        (lambda d: d["images"][0].update(extra=1), "extra"),
        (lambda d: d["images"][0].update(width="wide"), "width"),
    ],
)
def test_damaged_manifests_are_named(folder, change, message):
    edit(folder, change)
    with pytest.raises(CheckpointError, match=message):
        read_manifest(folder)


def test_missing_and_broken_manifests(folder):
    (folder / "manifest.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"manifest\.json"):
        read_manifest(folder)
    (folder / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match="no such file; run bench again"):
        read_manifest(folder)
