"""A small city at two dates, and databases of known poses for routes that need no photos."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import chronoscene  # noqa: F401  (loads zlib before pycolmap)
from benchmarks.registration.generated import pose_errors
from chronoscene.arrays import Array
from chronoscene.colmap.model import read_model
from chronoscene.formats import read_scene
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.models import image_pose
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.synth import SynthSettings, generate

SETTINGS = SynthSettings(
    periods=2, width=400, height=300, views=12, points=1000, blocks=2, supersample=1
)

IMAGES = 8
"""Photos of each period."""


@dataclass
class Case:
    """A database, what is true of it, and the arguments of a route."""

    folder: Path
    truth: dict[str, Array]
    """``cam_from_world`` by name. [4, 4]"""
    periods: dict[str, int]
    priors: dict[str, Any] | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def database(self) -> Path:
        return self.folder / "mapping.db"

    def arguments(self) -> dict[str, Any]:
        return {
            "database": str(self.database),
            "photos": str(self.folder / "photos"),
            "periods": self.periods,
            "labels": [f"summer {2016 + p}" for p in range(max(self.periods.values()) + 1)],
            "priors": self.priors,
            "keep_unplaced": False,
            "out": str(self.folder / "model"),
            "scratch": str(self.folder / "scratch"),
            "threads": 1,
        } | self.extra

    def run(self, route: Callable[..., dict[str, Any]]) -> dict[str, Any]:
        return route(self.arguments(), lambda *_: None)

    def estimated(self) -> dict[str, Array]:
        return {i.name: i.cam_from_world for i in read_model(self.folder / "model").images}

    def errors(self, *, reference: int | None = None) -> dict[int, tuple[float, float]]:
        """Median rotation (degrees) and centre error (share of the extent) of each period.

        The model is brought to the truth by the cameras of one period, or of all.
        """
        found = self.estimated()
        names = sorted(found)
        periods = np.array([self.periods[n] for n in names])
        poses, truth = (np.stack([d[n] for n in names]) for d in (found, self.truth))
        angles, distances = pose_errors(poses, truth, (periods == reference) | (reference is None))
        every = camera_centre(np.stack(list(self.truth.values())))
        extent = np.linalg.norm(np.ptp(every, axis=0))
        return {
            p: (
                float(np.median(angles[periods == p])),
                float(np.median(distances[periods == p]) / extent),
            )
            for p in np.unique(periods).tolist()
        }


@pytest.fixture(scope="session")
def truth(made_once: Callable[..., Path]) -> Scene:
    """A small city at two dates."""
    return read_scene(
        made_once("city", lambda folder: generate(folder / "scene", SETTINGS)) / "scene"
    )


@pytest.fixture
def make_case(tmp_path: Path) -> Callable[..., Case]:
    """Factory of cases."""

    def make(
        *,
        points: int = 300,
        noise: float = 0.5,
        moved: float = 0.0,
        cross_matches: float = 1.0,
        gps: float | None = None,
    ) -> Case:
        folder = tmp_path / f"case-{points}-{moved}-{cross_matches}"
        (folder / "photos").mkdir(parents=True)
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs = 2
        options.num_cameras_per_rig = 1
        options.num_frames_per_rig = IMAGES
        options.num_points3D = points
        options.camera_has_prior_focal_length = True
        disturb = pycolmap.SyntheticNoiseOptions()
        disturb.point2D_stddev = noise
        pycolmap.set_random_seed(3)
        with pycolmap.Database.open(str(folder / "mapping.db")) as database:
            model = pycolmap.synthesize_dataset(options, database)
            periods = {str(i.name): int(i.camera_id) - 1 for i in model.images.values()}
            truth = {str(i.name): image_pose(i) for i in model.images.values()}
            if moved:
                move_points(model, database, moved)
            pycolmap.synthesize_noise(disturb, model, database)
            if cross_matches < 1:
                thin_matches(model, database, cross_matches)
        case = Case(folder, truth, periods)
        if gps is not None:
            case.priors = noisy_gps(truth, gps)
        return case

    return make


def move_points(model: pycolmap.Reconstruction, database: pycolmap.Database, share: float) -> None:
    """The points at one side, so many of them, are elsewhere when period 1 sees them."""
    xyz = {i: p.xyz for i, p in model.points3D.items()}
    limit = np.quantile([p[0] for p in xyz.values()], share)
    extent = np.ptp([p[0] for p in xyz.values()])
    for image in model.images.values():
        if image.camera_id != 2:
            continue
        keypoints = np.asarray(database.read_keypoints(image.image_id)).copy()
        camera = model.cameras[image.camera_id]
        for k, point2D in enumerate(image.points2D):
            if point2D.has_point3D() and xyz[point2D.point3D_id][0] < limit:
                place = xyz[point2D.point3D_id] + 0.04 * extent * np.array([0.3, 0.8, 0.5])
                seen = camera.img_from_cam(image.cam_from_world() * place)
                if seen is not None:
                    keypoints[k, :2] = seen
        database.update_keypoints(image.image_id, keypoints)


def thin_matches(model: pycolmap.Reconstruction, database: pycolmap.Database, share: float) -> None:
    """Keep a share of the matches between periods; pairs without any are removed."""
    period = {i: image.camera_id for i, image in model.images.items()}
    pair_ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        if period[a] == period[b]:
            continue
        inliers = np.asarray(geometry.inlier_matches)
        keep = inliers[: round(share * len(inliers))]
        if not len(keep):
            database.delete_two_view_geometry(a, b)
            continue
        geometry.inlier_matches = keep
        database.update_two_view_geometry(a, b, geometry)


def noisy_gps(truth: dict[str, Array], noise: float) -> dict[str, Any]:
    """Positions in a frame of 200 m; every tenth is far off."""
    rng = np.random.default_rng(5)
    centres = {name: camera_centre(pose) for name, pose in truth.items()}
    scale = 200.0 / np.linalg.norm(np.ptp(np.stack(list(centres.values())), axis=0))
    enu = {n: (scale * c + rng.normal(0, noise, 3)).tolist() for n, c in centres.items()}
    for name in sorted(enu)[::10]:
        enu[name][0] += 500.0
    return {"enu": enu, "sigma": {name: [noise] * 3 for name in enu}}


@pytest.fixture
def write_database() -> Callable[..., dict[str, Any]]:
    """Write a database of photos, and return the arguments of a route; see `_database`."""
    return _database


def _database(
    folder: Path,
    poses: Sequence[Array],
    points: Array,
    sees: Sequence[NDArray[np.bool_]],
    true: pycolmap.Camera,
    camera: pycolmap.Camera | None = None,
    noise: float = 0.3,
) -> dict[str, Any]:
    """Write keypoints and verified matches of photos.

    Args:
        folder: Of the database.
        poses: ``cam_from_world`` of each photo.
        points: What they show. [P, 3]
        sees: Points that are detected in each photo, where they are in it. [P] each
        true: Camera that the photos are taken with.
        camera: Camera in the database; None for the true one.
        noise: Pixels.
    """
    rng = np.random.default_rng(5)
    (folder / "photos").mkdir(parents=True)
    names = [f"{i:02d}.jpg" for i in range(len(poses))]
    size = np.array([true.width, true.height])
    slots: list[dict[int, int]] = []
    with pycolmap.Database.open(str(folder / "mapping.db")) as database:
        camera = camera or true
        camera.has_prior_focal_length = True
        database.write_camera(camera)
        for name, pose, seen in zip(names, poses, sees, strict=True):
            local = points @ pose[:3, :3].T + pose[:3, 3]
            ahead = np.flatnonzero(seen & (local[:, 2] > 0.5))
            xy = np.array([true.img_from_cam(p) for p in local[ahead]], np.float64).reshape(-1, 2)
            inside = ((xy > 0) & (xy < size)).all(axis=1)
            xy = xy[inside] + rng.normal(0, noise, (int(inside.sum()), 2))
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=1))
            database.write_keypoints(image_id, xy.astype(np.float32))
            slots.append({int(k): i for i, k in enumerate(ahead[inside])})
        for i, a in enumerate(slots):
            for j in range(i + 1, len(slots)):
                shared = sorted(a.keys() & slots[j].keys())
                if len(shared) >= 15:
                    pairs = np.array([(a[k], slots[j][k]) for k in shared], np.uint32)
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    geometry.inlier_matches = pairs
                    database.write_matches(i + 1, j + 1, pairs)
                    database.write_two_view_geometry(i + 1, j + 1, geometry)
    return {
        "database": str(folder / "mapping.db"),
        "photos": str(folder / "photos"),
        "periods": dict.fromkeys(names, 0),
        "priors": None,
        "keep_unplaced": False,
        "out": str(folder / "model"),
        "scratch": str(folder / "scratch"),
        "threads": 1,
    }
