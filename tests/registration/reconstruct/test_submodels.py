"""Pairs of points of two models."""

import numpy as np

import chronoscene  # noqa: F401  (loads zlib before pycolmap)
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.submodels import point_pairs


def generated(points: int = 200) -> pycolmap.Reconstruction:
    """Two images that see the same points."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_cameras_per_rig = 1
    options.num_frames_per_rig = 2
    options.num_points3D = points
    pycolmap.set_random_seed(3)
    return pycolmap.synthesize_dataset(options)


def same_points(model: pycolmap.Reconstruction) -> np.ndarray:
    """Keypoints of images 1 and 2 that see one point. [M, 2]"""
    slots = [
        {p.point3D_id: k for k, p in enumerate(model.images[i].points2D) if p.has_point3D()}
        for i in (1, 2)
    ]
    return np.array([[slots[0][point], slots[1][point]] for point in slots[0].keys() & slots[1]])


def test_a_pair_of_points_counts_once_and_fits_both_images() -> None:
    model = generated()
    matches = same_points(model)
    found = point_pairs(model, model, [(1, 2, matches), (2, 1, matches[:, ::-1])])
    assert found is not None
    assert len(found) == len(matches) > 100
    np.testing.assert_array_equal(found.source, found.target)
    for side, image in (("target", 1), ("source", 2)):
        pose = getattr(found, f"{side}_pose")
        np.testing.assert_array_equal(pose[0, :3], model.images[image].cam_from_world().matrix())
        local = np.einsum("nij,nj->ni", pose[:, :3, :3], found.source) + pose[:, :3, 3]
        rays = getattr(found, f"{side}_ray")
        np.testing.assert_allclose(rays, local[:, :2] / local[:, 2:], atol=1e-6)
        assert (getattr(found, f"{side}_focal") == model.cameras[1].mean_focal_length()).all()


def test_keypoints_without_a_ray_are_left_out() -> None:
    """With strong distortion, no ray belongs to the corners of a photo."""
    model = generated()
    matches = same_points(model)
    model.cameras[1].params = [*model.cameras[1].params[:3], -5.0]
    rays = [model.cameras[1].cam_from_img(model.images[i].points2D) for i in (1, 2)]
    there = [np.isfinite(r[matches[:, k]]).all(axis=1) for k, r in enumerate(rays)]
    found = point_pairs(model, model, [(1, 2, matches)])
    assert found is not None
    assert len(found) == (there[0] & there[1]).sum() < len(matches)


def test_eleven_pairs_are_too_few() -> None:
    model = generated()
    matches = same_points(model)
    assert point_pairs(model, model, [(1, 2, matches[:11])]) is None
    found = point_pairs(model, model, [(1, 2, matches[:12])])
    assert found is not None and len(found) == 12
