"""Incremental mapping, triangulation and bundle adjustment by pycolmap. Worker process only."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import SEED, quiet, verified_matches
from chronoscene.registration.reconstruct.candidates import (
    SHORT_ANGLE,
    allow_short_tracks,
    support,
    without_weak_pairs,
)
from chronoscene.registration.reconstruct.consistency import loose_parts, point_agreements
from chronoscene.registration.reconstruct.gps_alignment import Priors
from chronoscene.registration.reconstruct.models import summary, write_model

MIN_MODEL_SIZE = 3
"""Images. COLMAP's default discards models that are a large part of a small period."""

SATISFIED = 0.9  # No further settings are tried if the largest model has this share of the images

LOSS_PIXELS = 1.0
"""Scale of the Cauchy loss: observations with much larger errors have little weight."""

MIN_INLIERS = 20  # 2D-3D correspondences needed to register an image with an existing model

MAX_ITERATIONS = 60
FUNCTION_TOLERANCE = 1e-6
"""Bundle adjustment ends after so many steps, or at a smaller relative decrease of the cost."""

DENSE_IMAGES = 300
"""Images up to which the reduced system of an adjustment is solved dense. Photos of one place on
several dates nearly all share points; COLMAP's sparse solver, from 50 on, takes half as long again
for 300 of them."""

MAX_REPROJECTION_ERROR = 4.0  # Pixels; observations that are further off are dropped
MIN_TRI_ANGLE = 1.5  # Degrees; points whose rays meet at smaller angles are dropped, usually

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


@dataclass(slots=True)
class Task:
    """Arguments and remarks that the functions of one task share."""

    database: str
    photos: str
    out: Path
    """Folder of the model."""
    scratch: Path
    threads: int
    report: Report
    remarks: list[str]
    """For the log; added to."""
    periods: Mapping[str, int]
    """Period of each image."""
    short: bool = False
    """True if points of two images and of small angles count (`candidates`)."""
    held: bool = False
    """True if focal lengths stay as they are in the database (`focal`)."""

    @property
    def min_angle(self) -> float:
        """Degrees; points whose rays meet at smaller angles are dropped."""
        return SHORT_ANGLE if self.short else MIN_TRI_ANGLE

    @classmethod
    def start(cls, arguments: Mapping[str, Any], report: Report) -> Task:
        """Begin a task with its arguments."""
        quiet()
        database, photos, threads = (arguments[k] for k in ("database", "photos", "threads"))
        out, scratch = Path(arguments["out"]), Path(arguments["scratch"])
        return cls(
            database,
            photos,
            out,
            scratch,
            threads,
            report,
            remarks=[],
            periods=arguments.get("periods", {}),
            short=arguments.get("short", False),
            held=arguments.get("held", False),
        )

    def finish(self, model: pycolmap.Reconstruction, **result: Any) -> dict[str, Any]:
        """Write the model, and return the result of the task, as JSON."""
        write_model(model, self.out, self.photos)
        _, matches = verified_matches(self.database)
        loose = loose_parts(point_agreements(model, matches), model.reg_image_ids())
        return {
            "remarks": self.remarks,
            "is_georeferenced": False,
            "positions_used": [],
            "model": summary(model),
            "left": [],
            "unplaced": [],
            "short": self.short,
            "held": self.held,
            "loose": sorted(str(model.images[i].name) for i in loose),
        } | result


def map_images(
    task: Task, names: Sequence[str], *, label: str = ""
) -> list[pycolmap.Reconstruction]:
    """Map images with several settings; the best result, its largest model first.

    Where the usual settings register most images, they count. Else the matches choose.

    Args:
        task: The task.
        names: Images to map.
        label: Prefix of the remarks, and folder below the scratch folder.
    """
    found = []
    folder = task.scratch / label
    for number, (kind, settings) in enumerate(SETTINGS):
        models = _run(task, folder / f"mapping-{number}", names, settings)
        found.append((kind, task, models))
        _note(task, f"mapping with {kind} settings", models, label)
        if models and models[0].num_reg_images() >= SATISFIED * len(names):
            return models
    certain = replace(task, database=str(folder / "certain.db"), short=True)
    if weak := without_weak_pairs(task.database, folder / "certain.db", task.periods):
        task.remarks.append(
            f"{weak} pairs of photos of two dates left out: few matches, none confirmed by others"
        )
    short = _run(certain, folder / "short", names, SETTINGS[-1][1])
    overall = _disjoint(map_globally(certain, folder / "global", names))
    for kind, models in (("short tracks", short), ("the global mapper", overall)):
        found.append((kind, certain, models))
        _note(task, f"mapping with {kind}", models, label)
    _, matches = verified_matches(certain.database)
    kind, best, models = max(found, key=lambda f: support(f[2][0], matches) if f[2] else -np.inf)
    if models:
        task.remarks.append(f"{kind}: chosen, as most matches agree with it")
        task.database, task.short = best.database, best.short
    return models


def _note(task: Task, kind: str, models: Sequence[pycolmap.Reconstruction], label: str) -> None:
    """Log what an attempt gave."""
    sizes = [int(m.num_reg_images()) for m in models]
    remark = f"{kind}: models of {sizes or 'no'} images"
    task.remarks.append(f"{label.replace('-', ' ')}: {remark}" if label else remark)


def pipeline_options(task: Task) -> pycolmap.IncrementalPipelineOptions:
    """Options of all mapping runs."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = MIN_MODEL_SIZE
    options.max_num_models = 20
    options.random_seed = SEED
    options.num_threads = task.threads
    options.image_path = task.photos
    options.extract_colors = False  # those of the final model are extracted when it is written
    options.ba_global_frames_ratio = 1.2
    options.ba_global_points_ratio = 1.2
    options.ba_refine_focal_length = not task.held
    if task.short:
        allow_short_tracks(options)
    return options


def _run(
    task: Task, out: Path, names: Sequence[str], settings: Mapping[str, Any]
) -> list[pycolmap.Reconstruction]:
    """Run the incremental mapper; disjoint models, the largest first."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    options = pipeline_options(task)
    options.image_names = list(names)
    for key, value in settings.items():
        setattr(options.mapper, key, value)
    if task.short:
        allow_short_tracks(options)
    count = _counter(task.report, "mapping", len(names))
    models = pycolmap.incremental_mapping(
        task.database, task.photos, str(out), options, next_image_callback=count
    )
    return _disjoint(sorted(models.values(), key=lambda m: -m.num_reg_images()))


def map_globally(task: Task, out: Path, names: Sequence[str]) -> list[pycolmap.Reconstruction]:
    """Map images by rotation averaging and global positioning; models, the largest first."""
    options = pycolmap.GlobalPipelineOptions()
    options.image_names = list(names)
    options.image_path = task.photos
    options.random_seed = SEED
    options.num_threads = options.mapper.num_threads = task.threads
    options.mapper.bundle_adjustment.refine_focal_length = not task.held
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    task.report("global mapping", 0, 1)
    models = pycolmap.global_mapping(task.database, task.photos, str(out), options)
    return sorted(models.values(), key=lambda m: -m.num_reg_images())


def _counter(report: Report, what: str, total: int) -> Callable[[], None]:
    """Return a function that reports one more image at each call."""
    done = 0

    def count() -> None:
        nonlocal done
        done = min(done + 1, total)
        report(what, done, total)

    report(what, 0, total)
    return count


def _disjoint(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Remove images that a larger model has, too: COLMAP lets models overlap."""
    taken: set[int] = set()
    kept = []
    for model in models:
        for image_id in sorted(set(model.reg_image_ids()) & taken):
            model.deregister_frame(model.images[image_id].frame_id)
        if model.num_reg_images() >= MIN_MODEL_SIZE:
            taken |= set(model.reg_image_ids())
            kept.append(model)
    return kept


def register_rest(
    model: pycolmap.Reconstruction, task: Task, total: int, folder: str
) -> pycolmap.Reconstruction:
    """Register images that have no pose yet, one after the other; the others do not move.

    Args:
        model: With points from the matches of its images.
        task: The task.
        total: Number of images in all.
        folder: Below the scratch folder.
    """
    scratch = task.scratch / folder
    shutil.rmtree(scratch, ignore_errors=True)
    for name in ("from", "to"):
        (scratch / name).mkdir(parents=True)
    model.write_binary(str(scratch / "from"))
    options = pipeline_options(task)
    options.multiple_models = False
    options.fix_existing_frames = True
    options.mapper.abs_pose_min_num_inliers = MIN_INLIERS
    options.constant_cameras = {model.images[i].camera_id for i in model.reg_image_ids()}
    models = pycolmap.incremental_mapping(
        task.database,
        task.photos,
        str(scratch / "to"),
        options,
        str(scratch / "from"),
        next_image_callback=_counter(task.report, "registering", total - model.num_reg_images()),
    )
    return max(models.values(), key=lambda m: m.num_reg_images()) if models else model


def triangulate(model: pycolmap.Reconstruction, task: Task, folder: str) -> pycolmap.Reconstruction:
    """Triangulate points again from all matches; poses and cameras do not change."""
    scratch = task.scratch / folder
    scratch.mkdir(parents=True, exist_ok=True)
    return pycolmap.triangulate_points(
        model,
        task.database,
        task.photos,
        str(scratch),
        clear_points=True,
        options=pipeline_options(task),
    )


def adjust(
    model: pycolmap.Reconstruction,
    task: Task,
    *,
    priors: Priors | None = None,
    constant: Collection[int] = (),
) -> str:
    """Adjust a model with a robust loss, then drop bad observations.

    Args:
        model: Changed in place.
        task: Its threads, and what it holds.
        priors: Position priors of images, with a robust loss; the model must lie in their frame.
        constant: Ids of images whose poses and cameras must not change.

    Returns:
        Why the solver stopped.
    """
    options = adjustment_options(task.threads, hold_focal=task.held)
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
    solved = adjuster.solve()
    drop_bad(model, task.min_angle)
    return str(solved.termination_type.name)


def adjustment_options(threads: int, *, hold_focal: bool) -> pycolmap.BundleAdjustmentOptions:
    """Return options with a robust loss."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = not hold_focal
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PIXELS
    options.ceres.max_num_images_direct_dense_cpu_solver = DENSE_IMAGES
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
    return options


def drop_bad(model: pycolmap.Reconstruction, min_angle: float = MIN_TRI_ANGLE) -> None:
    """Drop observations with a large error, and points with a small triangulation angle."""
    manager = pycolmap.ObservationManager(model)
    manager.filter_all_points3D(MAX_REPROJECTION_ERROR, min_angle)
    manager.filter_observations_with_negative_depth()
    model.update_point_3d_errors()


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
