"""Incremental mapping, triangulation and adjustment by pycolmap. Worker process only."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.errors import RegistrationError
from chronoscene.registration.features.database import SEED
from chronoscene.registration.reconstruct.submodels import Priors
from chronoscene.registration.worker import Report

SMALLEST_MODEL = 3
"""Images; what COLMAP gives up as too small is a large part of a small period."""

SATISFIED = 0.9
"""Share of the images in the largest model with which no other settings are tried."""

LOSS_PIXELS = 1.0
"""Scale of the Cauchy loss: an observation off by much more hardly pulls."""

LEAST_INLIERS = 20
"""Points with which an image is placed against a model that is there."""

MOST_ITERATIONS = 60
LEAST_PROGRESS = 1e-6
"""Of an adjustment: steps, and relative decrease of the cost below which it ends."""

MOST_REPROJECTION_ERROR = 4.0
LEAST_ANGLE = 1.5
"""Pixels and degrees beyond which observations and points are dropped."""

SETTINGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("default", {}),
    (
        "relaxed start (forward motion, small angles)",
        {
            "init_max_forward_motion": 1.0,
            "init_min_tri_angle": 3.0,
            "init_min_num_inliers": 50,
            "abs_pose_min_num_inliers": 20,
            "abs_pose_min_inlier_ratio": 0.15,
        },
    ),
)


def map_images(
    database: str, photos: str, names: Sequence[str], scratch: Path, threads: int, report: Report
) -> tuple[list[pycolmap.Reconstruction], list[str]]:
    """Models of some images, the largest first; the best of several settings.

    Returns:
        Models, and remarks.
    """
    best: list[pycolmap.Reconstruction] = []
    remarks = []
    for number, (label, settings) in enumerate(SETTINGS):
        options = pipeline_options(threads, photos)
        options.image_names = list(names)
        for key, value in settings.items():
            setattr(options.mapper, key, value)
        out = scratch / f"mapping-{number}"
        models = _run(database, photos, out, options, len(names), report)
        sizes = [int(m.num_reg_images()) for m in models]
        remarks.append(f"mapping with {label} settings: models of {sizes or 'no'} images")
        if sum(sizes[:1]) > sum(m.num_reg_images() for m in best[:1]):
            best = models
        if best and best[0].num_reg_images() >= SATISFIED * len(names):
            break
    return best, remarks


def nothing_mapped(count: int, *, tied: bool) -> RegistrationError:
    """The error of photos that give no model at all, with tie points or without."""
    also = "tie points bring models together, they do not make them; " if tied else ""
    return RegistrationError(
        "structure from motion",
        expected=f"a model of {count} photos",
        found="no two photos from which one can be begun",
        todo="give more photos that overlap by more than half, taken from different places; "
        f"{also}features and matches are kept",
    )


def pipeline_options(threads: int, photos: str) -> pycolmap.IncrementalPipelineOptions:
    """Options that all mapping shares."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = SMALLEST_MODEL
    options.max_num_models = 20
    options.random_seed = SEED
    options.num_threads = threads
    options.image_path = photos
    options.ba_global_frames_ratio = 1.2
    options.ba_global_points_ratio = 1.2
    return options


def _run(
    database: str,
    photos: str,
    out: Path,
    options: pycolmap.IncrementalPipelineOptions,
    total: int,
    report: Report,
) -> list[pycolmap.Reconstruction]:
    """Disjoint models of a mapping run, the largest first."""
    done = 0

    def count() -> None:
        nonlocal done
        done = min(done + 1, total)
        report("mapping", done, total)

    report("mapping", 0, total)
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    models = pycolmap.incremental_mapping(
        database, photos, str(out), options, next_image_callback=count
    )
    ordered = sorted(models.values(), key=lambda m: -m.num_reg_images())
    return _disjoint(ordered)


def _disjoint(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Models without the images that a larger one has: COLMAP lets models overlap."""
    taken: set[int] = set()
    kept = []
    for model in models:
        for image_id in sorted(set(model.reg_image_ids()) & taken):
            model.deregister_frame(model.images[image_id].frame_id)
        if model.num_reg_images() >= SMALLEST_MODEL:
            taken |= set(model.reg_image_ids())
            kept.append(model)
    return kept


def place_rest(
    model: pycolmap.Reconstruction,
    database: str,
    photos: str,
    scratch: Path,
    threads: int,
    total: int,
    report: Report,
) -> pycolmap.Reconstruction:
    """Place images that have no pose yet, one after the other; the others and their cameras stay.

    Args:
        model: With points from the matches of its images.
        total: Number of images in all.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    for name in ("from", "to"):
        (scratch / name).mkdir(parents=True)
    model.write_binary(str(scratch / "from"))
    options = pipeline_options(threads, photos)
    options.multiple_models = False
    options.fix_existing_frames = True
    options.mapper.abs_pose_min_num_inliers = LEAST_INLIERS
    options.constant_cameras = {model.images[i].camera_id for i in model.reg_image_ids()}
    left = total - int(model.num_reg_images())
    done = 0

    def count() -> None:
        nonlocal done
        done = min(done + 1, left)
        report("placing", done, left)

    models = pycolmap.incremental_mapping(
        database,
        photos,
        str(scratch / "to"),
        options,
        str(scratch / "from"),
        next_image_callback=count,
    )
    return max(models.values(), key=lambda m: m.num_reg_images()) if models else model


def triangulate(
    model: pycolmap.Reconstruction, database: str, photos: str, scratch: Path, threads: int
) -> pycolmap.Reconstruction:
    """New points of a model from all matches, poses and cameras as they are."""
    scratch.mkdir(parents=True, exist_ok=True)
    options = pipeline_options(threads, photos)
    return pycolmap.triangulate_points(
        model, database, photos, str(scratch), clear_points=True, options=options
    )


def adjust(
    model: pycolmap.Reconstruction,
    *,
    priors: Priors | None = None,
    constant: Collection[int] = (),
    threads: int = 1,
) -> str:
    """Bundle adjustment with a robust loss, and what is left off is dropped.

    Args:
        model: Changed in place.
        priors: Positions that pull, robustly, at the images they belong to; the model must lie in
            their frame.
        constant: Ids of images whose poses and cameras must not move.
        threads: Of the solver.

    Returns:
        Why the solver stopped.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PIXELS
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = MOST_ITERATIONS
    options.ceres.solver_options.function_tolerance = LEAST_PROGRESS
    config = pycolmap.BundleAdjustmentConfig()
    ids = sorted(model.reg_image_ids())
    for image_id in ids:
        config.add_image(image_id)
    for image_id in constant:
        config.set_constant_rig_from_world_pose(model.images[image_id].frame_id)
        config.set_constant_cam_intrinsics(model.images[image_id].camera_id)
    if priors is not None and priors.enu:
        adjuster = _with_priors(options, config, model, priors)
    else:
        if not constant:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    summary = adjuster.solve()
    drop_bad_observations(model)
    return str(summary.termination_type.name)


def _with_priors(
    options: pycolmap.BundleAdjustmentOptions,
    config: pycolmap.BundleAdjustmentConfig,
    model: pycolmap.Reconstruction,
    priors: Priors,
) -> pycolmap.BundleAdjuster:
    settings = pycolmap.PosePriorBundleAdjustmentOptions()
    settings.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    listed = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        if (position := priors.enu.get(str(image.name))) is None:
            continue
        prior = pycolmap.PosePrior(
            corr_data_id=image.data_id,
            position=np.asarray(position, np.float64),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            position_covariance=np.diag(np.asarray(priors.sigma[str(image.name)]) ** 2),
        )
        listed.append(prior)
    return pycolmap.create_pose_prior_bundle_adjuster(options, settings, config, listed, model)


def drop_bad_observations(model: pycolmap.Reconstruction) -> int:
    """Drop observations with a large error and points seen under a small angle; their number."""
    manager = pycolmap.ObservationManager(model)
    dropped = manager.filter_all_points3D(MOST_REPROJECTION_ERROR, LEAST_ANGLE)
    dropped += manager.filter_observations_with_negative_depth()
    model.update_point_3d_errors()
    return int(dropped)


def write_model(model: pycolmap.Reconstruction, folder: Path, photos: str) -> None:
    """Write a model with colours; the folder appears complete or not at all."""
    model.extract_colors_for_all_images(photos)
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    model.write_binary(str(partial))
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def summary(model: pycolmap.Reconstruction) -> Mapping[str, Any]:
    """Numbers for the log."""
    return {
        "images": int(model.num_reg_images()),
        "points": int(model.num_points3D()),
        "observations": int(model.compute_num_observations()),
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 4),
    }
