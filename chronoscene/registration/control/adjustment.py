"""Bundle adjustment with ground control, weighted by its accuracy. Worker process only.

COLMAP has no prior for a point. Two cameras that do not move stand in for it: so far away that
their projection is parallel, one from above and one from the south, with focal lengths such that a
pixel is one standard deviation of the coordinates. The robust loss limits a wrong point as it
limits a wrong match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.mapping import MAX_ITERATIONS, adjustment_options

DISTANCE = 1e5  # Between a point and the cameras that stand for its coordinates, world units
NOTHING = 1e-4  # Weight of east seen from the south: it is seen from above already

_FROM_ABOVE = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
_FROM_SOUTH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])

CLICKED_COLOR = np.array([255, 255, 255], np.uint8)


def adjust_with_control(
    model: pycolmap.Reconstruction,
    control: Sequence[Mapping[str, Any]],
    *,
    constant_cameras: bool = False,
    hold_focal: bool = False,
    threads: int = 1,
) -> dict[str, int]:
    """Adjust all poses, points and, unless they are known, cameras; control fixes the frame.

    Args:
        model: Changed in place; it lies near the control. The control points become points of it.
        control: Each with ``name``, ``xyz``, ``sigma`` (null for a point whose coordinates take no
            part) and ``clicks``: name of the image, x, y.
        constant_cameras: Keep the calibrations.
        hold_focal: Keep the focal lengths.
        threads: Of the solver.

    Returns:
        Id of the point of each control point.
    """
    ids = {str(c["name"]): add_point(model, c) for c in control}
    work = pycolmap.Reconstruction(model)  # with the cameras that stand for coordinates
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(work.reg_image_ids()):
        config.add_image(image_id)
        if constant_cameras:
            config.set_constant_cam_intrinsics(work.images[image_id].camera_id)
    for point in control:
        if point["sigma"] is not None:
            _add_coordinates(work, config, ids[str(point["name"])], point)
    options = adjustment_options(threads, hold_focal=hold_focal)
    options.ceres.solver_options.max_num_iterations = 2 * MAX_ITERATIONS
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, work)
    adjuster.solve()
    for image_id in model.reg_image_ids():
        image = work.images[image_id]
        frame = model.frames[model.images[image_id].frame_id]
        frame.set_cam_from_world(image.camera_id, image.cam_from_world())
        model.cameras[image.camera_id].params = work.cameras[image.camera_id].params.tolist()
    for point_id, point3D in model.points3D.items():
        point3D.xyz = work.points3D[point_id].xyz
    return ids


def add_point(model: pycolmap.Reconstruction, point: Mapping[str, Any]) -> int:
    """Add a clicked point with its clicks as observations; its id."""
    images = {str(image.name): i for i, image in model.images.items()}
    track = pycolmap.Track()
    for name, x, y in point["clicks"]:
        points2D = model.images[images[name]].points2D
        points2D.append(pycolmap.Point2D(np.array([x, y], np.float64)))
        track.add_element(images[name], len(points2D) - 1)
    return int(model.add_point3D(np.array(point["xyz"], np.float64), track, CLICKED_COLOR))


def _add_coordinates(
    model: pycolmap.Reconstruction,
    config: pycolmap.BundleAdjustmentConfig,
    point_id: int,
    point: Mapping[str, Any],
) -> None:
    east, north, up = DISTANCE / np.array(point["sigma"], np.float64)
    for rotation, focal in ((_FROM_ABOVE, (east, north)), (_FROM_SOUTH, (NOTHING * east, up))):
        camera_id, image_id = max(model.cameras) + 1, max(model.images) + 1
        params = [*focal, 0.0, 0.0]
        camera = pycolmap.Camera(
            camera_id=camera_id, model="PINHOLE", width=1, height=1, params=params
        )
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"control {image_id}", camera_id=camera_id, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.zeros(2))])
        translation = np.array([0, 0, DISTANCE]) - rotation @ np.array(point["xyz"], np.float64)
        pose = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
        model.add_image_with_trivial_frame(image, pose)
        model.add_observation(point_id, pycolmap.TrackElement(image_id, 0))
        config.add_image(image_id)
        config.set_constant_rig_from_world_pose(model.images[image_id].frame_id)
        config.set_constant_cam_intrinsics(camera_id)
