"""The raw reader agrees with the strict one on good models, in every form."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.colmap.model import read_model, read_raw_model, read_reconstruction
from chronoscene.colmap.raw_model import MODEL_FILES, find_model, model_files
from chronoscene.colmap.text import read_points, read_rigs
from chronoscene.scene.geometry import rotation_from_quaternion


@pytest.mark.parametrize("form", ["binary", "old", "text"])
def test_agrees_with_the_strict_reader(make_scene_folder, form):
    folder = make_scene_folder(form=form) / "sparse" / "0"
    raw, model = read_raw_model(folder), read_model(folder)
    assert raw.damages == ()
    order = np.argsort(raw.images.names)
    assert [raw.images.names[i] for i in order] == [image.name for image in model.images]
    assert raw.images.ids[order].tolist() == [image.image_id for image in model.images]
    assert {c.camera_id: c for c in raw.cameras} == {
        image.camera.camera_id: image.camera for image in model.images
    }
    rotations = rotation_from_quaternion(raw.images.quaternions)[order]
    strict = np.stack([image.cam_from_world for image in model.images])
    np.testing.assert_allclose(rotations, strict[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(raw.images.translations[order], strict[:, :3, 3], atol=1e-12)
    np.testing.assert_array_equal(raw.points.ids, model.points.ids)
    np.testing.assert_array_equal(raw.points.xyz, model.points.xyz)
    np.testing.assert_array_equal(raw.points.track_start, model.points.track_start)
    row = np.searchsorted(raw.images.ids, raw.points.track_image)
    keypoint = raw.images.keypoint_start[row] + raw.points.track_keypoint
    np.testing.assert_array_equal(raw.images.keypoint_xy[keypoint], model.points.track_xy)
    np.testing.assert_array_equal(np.argsort(order)[row], model.points.track_frame)


def test_rigs_of_both_forms_are_the_same(make_scene_folder, tmp_path):
    folder = make_scene_folder() / "sparse" / "0"
    read_reconstruction(folder).write_text(str(tmp_path))
    rigs = read_raw_model(folder).rigs
    assert rigs == read_raw_model(tmp_path).rigs
    assert len(rigs.frames) == len(read_model(folder).images)


@pytest.mark.parametrize("stem", ["rigs", "frames"])
def test_rigs_are_nothing_without_frames(make_scene_folder, stem):
    folder = make_scene_folder() / "sparse" / "0"
    (folder / f"{stem}.bin").unlink()
    raw = read_raw_model(folder)
    assert raw.rigs is None and raw.damages == ()


@pytest.mark.parametrize("line", ["", "1", "1 2 CAMERA 1", "1 99999999999 CAMERA 1", "x y", "1 -1"])
def test_damaged_text_rigs_are_none_or_empty(tmp_path, line):
    (tmp_path / "rigs.txt").write_text(f"# comment\n{line}\n")
    (tmp_path / "frames.txt").write_text("1 1 1 0 0 0 0 0 0 1 CAMERA 1 1\n")
    found = read_rigs(tmp_path)
    assert found is None or not any(found.rigs.values())
    (tmp_path / "rigs.txt").write_text("1 1 CAMERA 1\n")
    (tmp_path / "frames.txt").write_text(f"{line}\n")
    found = read_rigs(tmp_path)
    assert found is None or not found.frames


def test_binary_wins_only_if_complete(tmp_path):
    for file in ("cameras.bin", "images.bin", "cameras.txt", "images.txt", "points3D.txt"):
        (tmp_path / file).write_bytes(b"")
    assert set(model_files(tmp_path).values()) == {"cameras.txt", "images.txt", "points3D.txt"}
    (tmp_path / "points3D.bin").write_bytes(b"")
    assert set(model_files(tmp_path).values()) == {"cameras.bin", "images.bin", "points3D.bin"}


@given(
    tracks=st.dictionaries(
        st.integers(0, 2**40),
        st.lists(st.tuples(st.integers(0, 2**31 - 1), st.integers(0, 2**31 - 1)), max_size=4),
        max_size=8,
    ),
    data=st.data(),
)
def test_points_of_any_track_lengths_in_any_order(tmp_path_factory, tracks, data):
    order = data.draw(st.permutations(sorted(tracks)))
    lines = [
        f"{i} {i % 7} 0.5 -2 1 2 3 0.25 " + " ".join(f"{a} {b}" for a, b in tracks[i])
        for i in order
    ]
    path = tmp_path_factory.mktemp("points") / "points3D.txt"
    path.write_text("# comment\n\n" + "\n".join(lines))
    points = read_points(path)
    assert points.ids.tolist() == sorted(tracks)
    assert points.xyz[:, 0].tolist() == [i % 7 for i in sorted(tracks)]
    pairs = list(zip(points.track_image.tolist(), points.track_keypoint.tolist(), strict=True))
    ends = points.track_start.tolist()
    for row, i in enumerate(sorted(tracks)):
        assert pairs[ends[row] : ends[row + 1]] == tracks[i]


@pytest.mark.parametrize("target", ["cameras", "images", "points3D"])
def test_unreadable_file_is_a_damage(make_scene_folder, target, monkeypatch):
    read = Path.read_bytes

    def refuse(self):
        if self.name == f"{target}.txt":
            raise PermissionError(13, "Permission denied")
        return read(self)

    monkeypatch.setattr(Path, "read_bytes", refuse)
    raw = read_raw_model(make_scene_folder(form="text") / "sparse" / "0")
    assert [(d.file, d.found) for d in raw.damages] == [(f"{target}.txt", "Permission denied")]


def test_where_a_model_is(tmp_path):
    def model(place, stems=MODEL_FILES):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        for stem in stems:
            (tmp_path / place / f"{stem}.bin").touch()

    model("2016")  # of a year, not the 2016th model of this project
    model("", ["images"])  # perhaps a list of images
    assert find_model(tmp_path) is None
    model("")
    assert find_model(tmp_path) == ("", "images")
    model("distorted/sparse/0")
    assert find_model(tmp_path) == ("distorted/sparse/0", "images")
    (tmp_path / "input").mkdir()
    assert find_model(tmp_path) == ("distorted/sparse/0", "input")
    model("sparse", ["images"])
    assert find_model(tmp_path) == ("sparse", "images")
    model("sparse/10")
    model("sparse/2")
    assert find_model(tmp_path) == ("sparse/2", "images")
