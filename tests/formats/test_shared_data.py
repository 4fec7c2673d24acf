"""Every folder of real data is read, or refused with one clear message."""

import numpy as np
import pytest

from chronoscene.convert import convert
from chronoscene.errors import SceneError
from chronoscene.formats import detect, read_scene, writable_formats

READ = {
    "plaza": ("chronoscene", 108, 3),
    "sheffield_scene": ("chronoscene", 80, 2),
    "fox": ("nerfstudio", 50, 1),
}
"""Format, images and periods."""

IMAGES_ONLY = (
    "belvedere_glacier",
    "brighton_beach",
    "copr",
    "lund_street",
    "monstree",
    "sheffield_cross",
)

BARE_MODELS = ("sceaux_txt", "shared_camera_8of_many", "t265_fisheye_txt")


def test_no_folder_is_forgotten(shared_data):
    known = {*READ, *IMAGES_ONLY, "colmap_models", "stone_bench"}
    assert {p.name for p in shared_data.iterdir() if p.is_dir()} <= known


@pytest.mark.parametrize("name", READ)
def test_scenes_are_read(shared_data, name):
    scene = read_scene(shared_data / name)
    assert (scene.format, len(scene.frames), scene.num_periods) == READ[name]
    assert all(scene.image_path(frame).is_file() for frame in scene.frames)


@pytest.mark.parametrize("target", writable_formats())
@pytest.mark.parametrize("name", READ)
def test_scenes_are_converted(shared_data, tmp_path, name, target):
    scene = read_scene(shared_data / name)
    strict = {"cl-splats": "CL-Splats", "neusc": "NeuSC"}
    if name == "fox" and target in strict:
        with pytest.raises(SceneError, match=rf"that {strict[target]} reads: .* found OPENCV; run"):
            convert(shared_data / name, tmp_path / "out", target=target)
        return
    convert(shared_data / name, tmp_path / "out", target=target, image_source="symlink")
    again = read_scene(tmp_path / "out", format=target)
    new = {again.image_path(frame).resolve(): frame for frame in again.frames}
    assert len(new) == len(scene.frames)
    for old in scene.frames:
        frame = new[scene.image_path(old).resolve()]
        assert (frame.period, frame.camera) == (old.period, old.camera)
        assert frame.split == old.split or target in (*strict, "wat")  # theirs is fixed
        np.testing.assert_allclose(frame.cam_from_world, old.cam_from_world, atol=1e-10)
    np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
    if target != "nerfstudio":
        assert len(again.points.track_xy) == len(scene.points.track_xy)


@pytest.mark.parametrize("name", IMAGES_ONLY)
def test_images_without_poses_are_refused(shared_data, name):
    with pytest.raises(SceneError) as error:
        read_scene(shared_data / name)
    message = str(error.value)
    assert message.startswith(f"{shared_data / name}: expected a scene of a known format (")
    assert "found SOURCE.md, " in message and "images/" in message
    assert "; register these photos (chronoscene register), or give the folder of one" in message


@pytest.mark.parametrize("name", BARE_MODELS)
def test_bare_models_are_refused_with_what_to_do(shared_data, name):
    folder = shared_data / "colmap_models" / name
    with pytest.raises(SceneError, match="copy the images of the COLMAP model here to images/"):
        detect(folder)
    with pytest.raises(SceneError, match=r"expected images/ and a COLMAP model.* no folder im"):
        read_scene(folder, format="colmap-folders")


@pytest.mark.parametrize(("name", "images"), [("sceaux_txt", 11), ("shared_camera_8of_many", 8)])
def test_bare_models_with_a_table_of_periods(shared_data, tmp_path, name, images):
    """Moved to where they belong, they are read; the photos themselves need not be there."""
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/0").symlink_to(shared_data / "colmap_models" / name)
    model = read_names(tmp_path)
    assert len(model) == images
    table = tmp_path / "periods.csv"
    rows = "".join(f"{name},{i % 2}\n" for i, name in enumerate(model))
    table.write_text(f"file,period\n{rows}")
    scene = read_scene(tmp_path, format="colmap-folders", period_by=f"table:{table}")
    assert [f.period for f in scene.frames] == [i % 2 for i in range(images)]
    assert scene.frames[0].camera.model == "SIMPLE_RADIAL"


def read_names(folder):
    from chronoscene.colmap.model import read_model

    return [image.name for image in read_model(folder / "sparse/0").images]


def test_commas_in_a_text_model_are_refused(shared_data, tmp_path):
    (tmp_path / "images/x").mkdir(parents=True)
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/0").symlink_to(shared_data / "colmap_models/t265_fisheye_txt")
    with pytest.raises(SceneError, match="expected"):
        read_scene(tmp_path)
