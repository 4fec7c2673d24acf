"""Finished runs, opened again: their models render any camera at any period that they know."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array
from chronoscene.checks import check_choice, check_shape
from chronoscene.errors import CheckpointError, ConfigError, SceneError, ShapeError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.harness.files.records import (
    CHECKPOINT,
    PREDICTIONS,
    RUN_FILE,
    STAGES,
    RunRecord,
    read_config,
    read_run,
)
from chronoscene.harness.files.source import RunSource, read_source
from chronoscene.harness.files.strategies import STRATEGIES, Strategy, period_part
from chronoscene.harness.score.views import PredictedView, read_views
from chronoscene.images.store import ImageStore
from chronoscene.io.wording import joined, quote
from chronoscene.kernels.runtime import check_device
from chronoscene.methods import (
    Method,
    MethodConfig,
    MethodSpec,
    Prediction,
    View,
    config_from_values,
    load_spec,
    make_method,
)
from chronoscene.scene import Camera, Frame, Scene
from chronoscene.scene.cameras import CAMERA_MODELS
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.geometry import is_rotation
from chronoscene.scene.similarity import Sim3

NOT_RIGID = 1e-3  # Deviation from a rotation beyond which a pose is refused


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """The models of a finished run. Made by `open_run`.

    Cameras go in, and Gaussians and depths come out, in the world frame of the scene; the training
    frame of the method stays inside.
    """

    folder: Path
    record: RunRecord
    """Content of ``run.json``; for an earlier stage, its periods are those so far."""
    spec: MethodSpec
    source: RunSource
    config: MethodConfig
    """Configuration of the method."""
    training_from_world: Sim3
    device: str
    stage: int | None = None
    """Number of the period after which the model was saved; None for the last."""
    _models: dict[str, Method] = field(default_factory=dict)

    @property
    def strategy(self) -> Strategy:
        """Strategy by which its models were trained."""
        return STRATEGIES[self.record.strategy]

    @property
    def is_filtered(self) -> bool:
        """True if the models are drawn with the antialiasing filter."""
        return bool(getattr(self.config, "antialiased", False))

    @property
    def num_periods(self) -> int:
        """Number of periods that its models know."""
        return len(self.record.period_labels)

    @property
    def uses_period(self) -> bool:
        """True if the period is an input of its models."""
        return self.strategy.period_is_input(self.spec)

    @property
    def distinguishes_periods(self) -> bool:
        """True if it can show different things in different periods."""
        return self.uses_period or self.strategy.model_per_period

    @property
    def is_continuous(self) -> bool:
        """True if periods in between, such as 0.5, can be rendered."""
        return self.spec.period_input == "continuous" and self.uses_period

    def check_period(self, period: float) -> None:
        """Check that the models can render a period.

        Raises:
            ConfigError: If it is not one of theirs, or fractional where the method takes whole
                ones only.
        """
        if not isinstance(period, Real):  # a label, which `parse_period` takes
            raise self._no_period(repr(period))
        if not 0 <= period <= self.num_periods - 1:
            raise self._no_period(f"{period:g}")
        if period != int(period) and not self.is_continuous:
            raise ConfigError(
                f"period {period:g}",
                expected=f"a whole number: {self.spec.title} under strategy {self.record.strategy} "
                "has nothing between the periods",
                found="a fraction",
                todo=f"choose {int(period)} or {int(period) + 1}",
            )

    def parse_period(self, text: str) -> float:
        """Return the period that a label or a number names.

        Raises:
            ConfigError: If no period has this label or number, or several have the label.
        """
        named = [i for i, label in self.record.period_labels.items() if label == text]
        if len(named) > 1:
            raise ConfigError(
                f"period {text!r}",
                expected="the label of one period",
                found=f"that of {joined(named)}",
                todo="name it by its number",
            )
        if named:
            return float(named[0])
        try:
            period = float(text)
        except ValueError:
            raise self._no_period(repr(text)) from None
        self.check_period(period)
        return period

    def parse_periods(self, text: str) -> tuple[float, ...]:
        """Parse one period, or both ends of a range ``FROM:TO``, as `parse_period` does."""
        parts = [text] if text in self.record.period_labels.values() else text.split(":", 1)
        return tuple(self.parse_period(part) for part in parts)

    def _no_period(self, name: str) -> ConfigError:
        labels = ", ".join(f"{i} ({name})" for i, name in self.record.period_labels.items())
        return ConfigError(
            f"period {name}",
            expected=f"one from 0 to {self.num_periods - 1}",
            found="another",
            todo=f"choose among {labels}",
        )

    def model(self, period: float) -> Method:
        """Return the model that renders a period; it is loaded at its first use."""
        last = self.num_periods - 1 if self.strategy.in_order else int(period)
        split = self.strategy.model_per_period or self.strategy.in_order
        part = period_part(last) if split else ""
        if part not in self._models:
            self._models[part] = self.load(self.folder / CHECKPOINT / part)
        return self._models[part]

    def load(self, folder: Path) -> Method:
        """Load a model from a folder that `Method.save` wrote."""
        if not folder.is_dir():
            raise CheckpointError(
                folder,
                expected="the model of the run",
                found="no such folder",
                todo="copy it there, or delete the run and run bench again",
            )
        method = make_method(self.spec, self.config)
        method.load(folder, device=self.device)
        return method

    def model_period(self, period: float) -> float:
        """Return the period as input of a model: 0 where the period is no input."""
        return float(period) if self.uses_period else 0.0

    def view(self, camera: Camera, cam_from_world: Array) -> View:
        """Return a camera with its pose [4, 4] in the training frame.

        Raises:
            ConfigError: If the camera has distortion, or is none.
            ShapeError: If the pose is none.
        """
        place = f"camera {camera.camera_id}"
        model = CAMERA_MODELS[check_choice(f"{place}: model", camera.model, CAMERA_MODELS)]
        if not camera.is_usable:
            raise ConfigError(
                place,
                expected=f"a width, a height and the parameters {', '.join(model.params)}, with "
                "positive focal lengths",
                found=f"{camera.width}, {camera.height} and {camera.params}",
                todo="correct the camera",
            )
        if not camera.is_pinhole:
            raise ConfigError(
                place,
                expected="a pinhole camera without distortion",
                found=camera.model,
                todo="use chronoscene.scene.cameras.undistorted_camera",
            )
        pose = np.asarray(cam_from_world, np.float64)
        check_shape("cam_from_world", pose, (4, 4))
        is_rigid = is_rotation(pose[:3, :3], NOT_RIGID) and pose[3].tolist() == [0, 0, 0, 1]
        if not (is_rigid and np.isfinite(pose).all()):
            raise ShapeError(
                "cam_from_world",
                expected="[[R, t], [0, 1]] with a rotation R and a finite translation t",
                found=str(pose.tolist()),
                todo="pass a transform from the world to the camera, without a scale",
            )
        pose = self.training_from_world.apply_to_pose(pose)
        return View(camera.K, camera.width, camera.height, pose)

    def photos(self, scene: Scene) -> ImageStore:
        """Return the photos of the scene, at the size of the training."""
        return ImageStore(scene, max_width=self.record.max_width)

    def frame_views(self, scene: Scene, frames: Iterable[Frame]) -> list[View]:
        """Return frames of the scene as `view` does, at the size of the training."""
        store = self.photos(scene)
        return [self.view(store.camera(frame), frame.cam_from_world) for frame in frames]

    def render(
        self,
        camera: Camera,
        cam_from_world: Array,
        period: float,
        *,
        appearance_period: float | None = None,
    ) -> Prediction:
        """Render what a camera sees in a period.

        Args:
            camera: Intrinsics in pixels, without distortion.
            cam_from_world: Pose in the world frame of the scene. [4, 4]
            period: 0 to ``num_periods - 1``; fractional only if `is_continuous`.
            appearance_period: Period whose colours the geometry of ``period`` gets.

        Returns:
            ``rgb`` in 0..1 [H, W, 3]; where the method gives them, ``alpha`` [H, W] and ``depth``
            in world units [H, W]. All are NumPy arrays in float32.

        Raises:
            ConfigError: If the camera has distortion, the period is not one of the run, or the
                method cannot combine two periods.
            ShapeError: If the pose is not a rotation and a translation.

        Example:
            >>> run = open_run("runs/plaza/chronogs-joint-balanced/seed0")
            >>> frame = run.scene().frames[0]
            >>> image = run.render(frame.camera, frame.cam_from_world, period=1).rgb
        """
        self.check_period(period)
        view, model = self.view(camera, cam_from_world), self.model(period)
        if appearance_period is None:
            prediction = model.render(view, self.model_period(period))
        else:
            self.check_appearance(appearance_period)
            prediction = model.render_split(
                view, geometry_period=period, appearance_period=appearance_period
            )
        if prediction.depth is None:
            return prediction
        return replace(prediction, depth=prediction.depth / self.training_from_world.scale)

    @property
    def separates_appearance(self) -> bool:
        """True if it can show the geometry of one period in the colours of another."""
        return self.uses_period and hasattr(self.model(0), "render_split")

    def check_appearance(self, period: float) -> None:
        """Check that a model can render a geometry in the colours of this period.

        Raises:
            ConfigError: If it cannot, or the period is not one of the run.
        """
        self.check_period(period)
        if not self.separates_appearance:
            raise ConfigError(
                f"appearance of period {period:g}",
                expected="one model of all periods that keeps geometry and colours apart",
                found=f"{self.spec.title} under strategy {self.record.strategy}",
                todo="leave it out, or open a run of chronogs under strategy joint",
            )

    def gaussians(
        self, period: float, *, scene: Scene | None = None, target_from_world: Sim3 | None = None
    ) -> GaussianCloud:
        """Return the model of a period as Gaussians in the world frame of the scene.

        What changes with the direction of view (such as the opacities of ChronoGS) is fitted to the
        training views. Where ``config.antialiased`` is true, renderers need the same filter.

        Args:
            period: As for `render`.
            scene: The scene of the run, if it has been read already.
            target_from_world: Frame with axes parallel to the world's in which to return them, for
                worlds whose coordinates float32 cannot hold.

        Returns:
            float32 arrays; positions and sizes in units of the frame.

        Raises:
            ConfigError: If the period is not one of the run, or the method has no Gaussians.
            CheckpointError: If the model is missing.
            SceneError: If the scene is missing.
        """
        self.check_period(period)
        model = self.model(period)
        if not hasattr(model, "to_gaussians"):
            raise ConfigError(
                self.folder,
                expected="a model made of Gaussians, as pages and exports need",
                found=self.spec.title,
                todo="choose a run of another method, such as chronogs; render and view show this "
                "one",
            )
        scene = scene or self.scene()
        own = int(period) if self.strategy.model_per_period else None
        frames = scene.select(split="train", period=own)
        views = self.frame_views(scene, (f for f in frames if f.period < self.num_periods))
        gaussians = model.to_gaussians(self.model_period(period), views)
        world_from_training = self.training_from_world.inverse()
        if target_from_world is None:
            return gaussians.transformed(world_from_training)
        return gaussians.transformed(target_from_world @ world_from_training)

    def training_from_local(self, offset: ArrayLike) -> Sim3:
        """Return the transform into the training frame from the world minus an offset [3]."""
        return self.training_from_world @ Sim3(1.0, np.eye(3), np.asarray(offset, np.float64))

    def test_views(self) -> Iterator[PredictedView]:
        """Yield the test views with prediction and photo, as bench wrote and scored them.

        Neither the model nor the scene is needed.

        Raises:
            CheckpointError: If an image is missing or was changed.

        Example:
            >>> errors = [abs(v.prediction - v.truth).mean() for v in run.test_views()]
        """
        truth = ground_truth_folder(self.folder.resolve().parents[2], self.record.scene)
        staged = self.folder / STAGES / period_part(self.num_periods - 1)
        if self.stage is not None and staged.is_dir():
            return read_views(staged, truth, fitted=self.record.fitted, stage=True)
        return read_views(self.folder / PREDICTIONS, truth, fitted=self.record.fitted)

    def scene(self, root: str | Path | None = None) -> Scene:
        """Read the scene that the run was trained on, from ``root`` if it has moved.

        Raises:
            SceneError: If it is missing, cannot be read, or is another one.
        """
        place, found = Path(root or self.source.scene_root), "nothing"
        if place.exists():
            scene = self.source.read_scene(place)
            if scene_hash(scene) == self.record.scene_hash:
                return scene
            found = "another scene, or a changed one"
        raise SceneError(
            place,
            expected="the scene that the run was trained on",
            found=found,
            todo="name the folder where it is with --scene",
        )


def open_run(
    folder: str | Path,
    *,
    device: str = "cpu",
    plugin: str | Sequence[str] = (),
    stage: int | None = None,
) -> TrainedRun:
    """Open the folder of a finished run, ``RUNS/<scene>/<method>-<strategy>-<preset>/seed<k>``.

    Models are loaded at their first use. Nothing that the run brings is executed: its method is an
    installed one, or one of ``plugin``.

    Args:
        folder: Folder with ``run.json``.
        device: ``cpu`` or ``cuda``.
        plugin: ``module:SPEC`` of a method that is not installed, or several. They are imported,
            which executes their code.
        stage: For a run under ``sequential``, the period after whose training the model was
            saved; None for the last.

    Raises:
        CheckpointError: If the folder has no finished run, or a file is damaged.
        ConfigError: If the method is neither installed nor in ``plugin``, or there is no such
            stage or device.
        BackendError: If this machine lacks the device.
    """
    check_choice("device", device, ("cpu", "cuda"))
    folder = Path(folder)
    record = read_run(folder)
    if not (folder / CHECKPOINT).is_dir():
        raise CheckpointError(
            folder,
            expected="a run with a model",
            found=f"no folder {CHECKPOINT}",
            todo="open a run that bench trained, with its checkpoint",
        )
    check_choice(f"{folder / RUN_FILE}: strategy", record.strategy, STRATEGIES)
    if stage is not None:
        record = _at_stage(record, stage)
    source = read_source(folder)
    spec = _find_spec(record, source, [plugin] if isinstance(plugin, str) else plugin)
    if spec.runner is not None:
        raise CheckpointError(
            folder,
            expected="a run of a method that renders here",
            found=f"one of {spec.title}, which is another program",
            todo=f"open the files in its folder {CHECKPOINT} with that program",
        )
    check_device(device, gsplat=spec.draws_gaussians)
    return TrainedRun(
        folder=folder,
        record=record,
        spec=spec,
        source=source,
        config=config_from_values(spec, read_config(folder)["config"]["method_config"]),
        training_from_world=Sim3.from_matrix(source.training_from_world),
        device=device,
        stage=stage,
    )


def _find_spec(record: RunRecord, source: RunSource, plugins: Sequence[str]) -> MethodSpec:
    """Find the method of a run; never import a module because the run names it."""
    if ":" not in source.method:
        try:
            return load_spec(source.method)
        except ConfigError as error:
            raise ConfigError(
                quote(source.method),
                expected=f"the method of the run, from {record.method_version}",
                found=error.found,
                todo="install it",
            ) from error
    for spec in map(load_spec, plugins):
        if spec.name == record.method:
            return spec
    raise ConfigError(
        quote(record.method),
        expected=f"an installed method, or one of {', '.join(plugins) or '--plugin'}",
        found=f"{quote(source.method)} from {quote(source.plugin_path or 'nowhere')}",
        todo="if you have its code and trust it, add --plugin module:SPEC (in Python, plugin=), in "
        "the folder of the module or with that in PYTHONPATH",
    )


def _at_stage(record: RunRecord, stage: int) -> RunRecord:
    """Return the record with the periods of a stage and those before."""
    stages = len(record.period_labels) if STRATEGIES[record.strategy].in_order else 0
    if stage not in range(stages):
        raise ConfigError(
            f"stage {stage}",
            expected=f"one from 0 to {stages - 1}" if stages else "a run in stages",
            found="another" if stages else f"strategy {record.strategy}",
            todo="choose one of these" if stages else "leave it out",
        )
    labels = dict(list(record.period_labels.items())[: stage + 1])
    return record.model_copy(update={"period_labels": labels})
