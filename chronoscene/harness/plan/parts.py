"""Training frame and training sets of a method under each strategy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from shlex import quote

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.checks import check_choice
from chronoscene.errors import SceneError
from chronoscene.harness.files.strategies import STRATEGIES, period_part
from chronoscene.harness.plan.sparse_depths import depth_loader
from chronoscene.images.store import ImageStore
from chronoscene.methods import MethodSpec, TrainingSet, TrainingView, View
from chronoscene.scene import Frame, Scene
from chronoscene.scene.cameras import PINHOLE_MODELS, project_points, way_to_pinhole
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3

EXTENT_MARGIN = 1.1  # Factor of 3DGS between the farthest camera and the camera extent
CLOSE = 0.5
"""Cameras within this share of the depth of what they see leave the size of the scene to it."""
MOST_VIEWS, MOST_POINTS = 100, 5_000  # For a median depth
LEAST_SPREAD = 1e-6  # Of the points, relative to the distance of the farthest camera


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A model to train, or a stage of its training, and the test views that it answers for."""

    name: str
    """``all``, or that of `period_part`."""
    train: TrainingSet
    test: tuple[Frame, ...]
    store: ImageStore
    hides_period: bool
    """True if the model renders period 0 for views of any period."""
    last: int
    """The last period whose images it was trained on."""
    extends: bool = False
    """True if the training begins with the model of the part before."""
    ahead: tuple[Frame, ...] = ()
    """Test views of the period that the next stage learns."""

    @property
    def subfolder(self) -> str:
        """Folder of its model below the checkpoint; empty if it is the only one."""
        return "" if self.name == "all" else self.name

    def view(self, frame: Frame) -> View:
        """The camera of a frame at the evaluation size, in the training frame."""
        camera = self.store.camera(frame)
        pose = self.train.training_from_world.apply_to_pose(frame.cam_from_world)
        return View(camera.K, camera.width, camera.height, pose)

    def method_period(self, frame: Frame) -> float:
        """The period to ask the model for to predict a frame."""
        return 0.0 if self.hides_period else float(self.shown_period(frame))

    def shown_period(self, frame: Frame) -> int:
        """The period that a prediction of a frame shows: its own, or the last that is known."""
        return min(frame.period, self.last)


def effective_strategy(spec: MethodSpec, strategy: str) -> tuple[str, str | None]:
    """The strategy that a method can follow, and a notice where it is not the one asked for."""
    check_choice("--strategy", strategy, STRATEGIES)
    kind = STRATEGIES[strategy]
    if kind.gives_period and not kind.period_is_input(spec) and not kind.in_order:
        notice = f"{spec.name} takes no period: {strategy} is run and recorded as pooled"
        return "pooled", notice
    return strategy, None


def make_parts(
    scene: Scene, store: ImageStore, strategy: str, *, takes_period: bool = True
) -> tuple[Part, ...]:
    """The training sets of a strategy, in the order of the trainings.

    The training frame comes from all training cameras of the scene, so that learning rates and
    voxel sizes mean the same length whatever the strategy. Under ``sequential`` it comes from those
    of the first period, as no others are known when the training begins.

    Args:
        scene: What is trained on.
        store: Its images.
        strategy: One of `STRATEGIES`.
        takes_period: False if the method does not take the period.

    Raises:
        SceneError: If a camera is distorted, images or points are missing that are needed, or all
            points are in one place.
    """
    check_choice("--strategy", strategy, STRATEGIES)
    check_scene(scene)
    kind = STRATEGIES[strategy]
    hide, everything = not (kind.gives_period and takes_period), range(scene.num_periods)
    to_training = training_frame(scene, everything[:1] if kind.in_order else everything)
    if not kind.model_per_period and not kind.in_order:
        train = _training_set(scene, store, to_training, everything, everything, hide_period=hide)
        return (Part("all", train, scene.select(split="test"), store, hide, everything[-1]),)
    parts = []
    for period in everything:
        own = everything[period : period + 1]
        known = everything[: period + 1] if kind.in_order else own
        train = _training_set(scene, store, to_training, own, known, hide_period=hide)
        test = tuple(f for f in scene.select(split="test") if f.period in known)
        part = Part(period_part(period), train, test, store, hide, period)
        if kind.in_order:
            ahead = scene.select(split="test", period=period + 1)
            part = replace(part, extends=period > 0, ahead=ahead)
        parts.append(part)
    return tuple(parts)


def check_scene(scene: Scene) -> None:
    """Refuse scenes that no method can be trained on.

    Raises:
        SceneError: If a camera is distorted, or there is no training image.
    """
    for frame in scene.frames:
        if not frame.camera.is_pinhole:
            raise SceneError(
                f"{scene.root}: {frame.name}",
                expected=f"a camera without distortion ({', '.join(PINHOLE_MODELS)}, or "
                "another model whose distortion parameters are all zero)",
                found=frame.camera.model,
                todo=f"{way_to_pinhole(frame.camera, f'{quote(str(scene.root))} OUT')} first",
            )
    if not scene.select(split="train"):
        raise SceneError(
            scene.root,
            expected="at least one train image",
            found=f"none ({scene.split_rule})",
            todo=f"hold out whole periods (chronoscene split {quote(str(scene.root))} --scene-out "
            "NEW --strategy periods --period ID), and use NEW",
        )


def check_points(scene: Scene) -> None:
    """Refuse scenes without points to start from.

    Raises:
        SceneError: If there are none, or training images see none of them.
    """
    if not _seen(scene, range(scene.num_periods)).any():
        raise _no_points(scene.root)


def _no_points(place: object) -> SceneError:
    return SceneError(
        place,
        expected="sparse points that a training image sees",
        found="none",
        todo="triangulate some: chronoscene triangulate SCENE OUT",
    )


def training_frame(scene: Scene, periods: range | None = None) -> Sim3:
    """``training_from_world``: mean training camera at the origin, the farthest at distance 1.

    Where cameras stand close together before what they see, half of its depth becomes 1 instead.

    Args:
        scene: With training images.
        periods: Those whose cameras and points count; None for all.
    """
    periods = range(scene.num_periods) if periods is None else periods
    frames = _training_frames(scene, periods)
    centres = _centres(frames)
    centre = centres.mean(axis=0)
    radius = float(np.linalg.norm(centres - centre, axis=1).max())
    if radius <= 1e-9 * max(1.0, float(np.abs(centre).max())):
        radius = 0.0  # nothing but rounding
    points = scene.points.xyz[_seen(scene, periods).any(axis=1)]
    size = max(radius, CLOSE * _median_depth(frames, points))
    scale = 1.0 / size if size > 0 else 1.0
    return Sim3(scale, np.eye(3), -scale * centre)


def _median_depth(frames: Sequence[Frame], xyz: Array) -> float:
    """Return the median over images of the median depth of the points in them; 0 without any.

    Large sets of images and points are sampled evenly.
    """
    frames = frames[:: len(frames) // MOST_VIEWS + 1]
    xyz = xyz[:: len(xyz) // MOST_POINTS + 1]
    depths = []
    for frame in frames:
        seen = xyz @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
        pixels = project_points(frame.camera, seen)
        size = (frame.camera.width, frame.camera.height)
        inside = ((pixels >= 0) & (pixels <= size)).all(axis=1)
        if inside.any():
            depths.append(np.median(seen[inside, 2]))
    return float(np.median(depths)) if depths else 0.0


def _training_frames(scene: Scene, periods: range) -> tuple[Frame, ...]:
    """Training images of some periods."""
    frames = tuple(f for f in scene.select(split="train") if f.period in periods)
    if not frames:
        raise SceneError(
            f"{scene.root}: period {periods[-1]}",
            expected="at least one training image",
            found="none",
            todo="move one from test to train, or use another strategy",
        )
    return frames


def _seen(scene: Scene, periods: range) -> Mask:
    """Return True where a training image of one of these periods sees the point. [P, T]

    Points of other sources than COLMAP, such as laser scans, have no tracks: if that is true of
    all, they count as seen in every period.
    """
    if len(scene.points) and not scene.points.track_frame.size:
        return np.ones((len(scene.points), scene.num_periods), bool)
    counts = [f.split == "train" and f.period in periods for f in scene.frames]
    return scene.point_periods(np.array(counts))


def _centres(frames: Sequence[Frame]) -> Array:
    return camera_centre(np.stack([f.cam_from_world for f in frames]))


def _training_set(
    scene: Scene,
    store: ImageStore,
    to_training: Sim3,
    periods: range,
    known: range,
    *,
    hide_period: bool,
) -> TrainingSet:
    """Training set of some periods, with the points of those that are known by then."""
    frames, seen = _training_frames(scene, periods), _seen(scene, known)[:, : known.stop]
    kept = seen.any(axis=1)
    if not kept.any():
        raise _no_points(f"{scene.root}: period {known[-1]}" if len(known) == 1 else scene.root)
    points = to_training.apply(scene.points.xyz[kept])
    if np.ptp(points, axis=0).max() < LEAST_SPREAD:
        raise SceneError(
            scene.root,
            expected="sparse points in different places",
            found=f"{len(points)} in one place",
            todo="triangulate some: chronoscene triangulate SCENE OUT",
        )
    camera_extent = _camera_extent(frames, to_training)
    depth = to_training.scale * _median_depth(frames, scene.points.xyz[kept])
    return TrainingSet(
        views=tuple(_training_view(f, store, to_training, hide_period) for f in frames),
        num_periods=1 if hide_period else known.stop,
        points=points.astype(np.float32),
        colors=scene.points.rgb[kept],
        point_periods=np.ones((int(kept.sum()), 1), bool) if hide_period else seen[kept],
        training_from_world=to_training,
        camera_extent=camera_extent,
        scene_extent=max(camera_extent, EXTENT_MARGIN * CLOSE * depth),
        background=np.zeros(3, np.float32),
        load_image=lambda i: store.load(frames[i]),
        load_mask=lambda i: store.load_mask(frames[i]),
        load_depths=depth_loader(scene, frames, store, to_training.scale),
        expect=lambda indices: store.expect([frames[i] for i in indices]),
    )


def _training_view(
    frame: Frame, store: ImageStore, to_training: Sim3, hide_period: bool
) -> TrainingView:
    camera = store.camera(frame)
    pose = to_training.apply_to_pose(frame.cam_from_world)
    period = 0 if hide_period else frame.period
    return TrainingView(camera.K, camera.width, camera.height, pose, frame.name, period)


def _camera_extent(frames: Sequence[Frame], to_training: Sim3) -> float:
    """1.1 times the largest distance of a camera from their mean; that of the scene for one camera.

    An extent of zero would turn learning rates that are tied to it into zero.
    """
    centres = to_training.apply(_centres(frames))
    radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    return EXTENT_MARGIN * (radius if radius > 1e-6 else 1.0)
