"""A finished run, opened again: its models render any camera at any period that they claim."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.files.provenance import scene_hash
from chronoscene.bench.files.records import (
    CHECKPOINT,
    SOURCE_FILE,
    RunRecord,
    read_config,
    read_run,
)
from chronoscene.bench.files.source import RunSource, _read_source
from chronoscene.bench.files.strategies import STRATEGIES, Strategy, period_part
from chronoscene.errors import CheckpointError, ConfigError, SceneError
from chronoscene.formats import read_scene
from chronoscene.kernels.runtime import check_device
from chronoscene.methods import (
    Method,
    MethodSpec,
    Prediction,
    View,
    config_from_values,
    import_object,
    load_spec,
)
from chronoscene.scene import Camera, Scene
from chronoscene.scene.similarity import Sim3


@dataclass(frozen=True, eq=False)
class OpenRun:
    """The models of a finished run. Made by `open_run`."""

    folder: Path
    record: RunRecord
    """Of an earlier stage: its periods are those so far."""
    spec: MethodSpec
    source: RunSource
    config: Any
    """Of the method."""
    training_from_world: Sim3
    device: str
    _models: dict[str, Method] = field(default_factory=dict)

    @property
    def strategy(self) -> Strategy:
        """What its models know of the periods."""
        return STRATEGIES[self.record.strategy]

    @property
    def num_periods(self) -> int:
        """Periods that its models know, numbered from 0."""
        return len(self.record.period_labels)

    @property
    def tells_period(self) -> bool:
        """Whether its models are told the period."""
        return self.strategy.tells(self.spec)

    @property
    def is_continuous(self) -> bool:
        """Whether periods in between, such as 0.5, can be rendered."""
        return self.spec.period_input == "continuous" and self.tells_period

    def check_period(self, period: float) -> None:
        """Refuse a period that the models do not claim.

        Raises:
            ConfigError: If it is outside of those that they know, or fractional where the method
                takes whole ones only.
        """
        if not 0 <= period <= self.num_periods - 1:
            raise self._no_period(f"{period:g}")
        if period != int(period) and not self.is_continuous:
            raise ConfigError(
                f"period {period:g}",
                expected=f"a whole number: {self.spec.title} under strategy {self.record.strategy} "
                "knows no time between the periods",
                found="a fraction",
                todo=f"choose {int(period)} or {int(period) + 1}",
            )

    def parse_period(self, text: str) -> float:
        """The period that a label or a number names.

        Raises:
            ConfigError: If none has the label, or the models do not claim the number.
        """
        for number, label in self.record.period_labels.items():
            if label == text:
                return float(number)
        try:
            period = float(text)
        except ValueError:
            raise self._no_period(repr(text)) from None
        self.check_period(period)
        return period

    def parse_periods(self, text: str) -> tuple[float, ...]:
        """One period, or both ends of a range ``FROM:TO``; errors as for `parse_period`."""
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
        """The model that answers for a period, loaded at its first use."""
        last = self.num_periods - 1 if self.strategy.in_order else int(period)
        split = self.strategy.model_per_period or self.strategy.in_order
        part = period_part(last) if split else ""
        if part not in self._models:
            self._models[part] = self.load(self.folder / CHECKPOINT / part)
        return self._models[part]

    def load(self, folder: Path) -> Method:
        """A model of the method, from where `Method.save` wrote it."""
        if not folder.is_dir():
            raise CheckpointError(
                folder,
                expected="the model of the run",
                found="no such folder",
                todo="copy it there, or delete the run and run bench again",
            )
        method: Method = import_object(self.spec.method)(self.config)
        method.load(folder, device=self.device)
        return method

    def told(self, period: float) -> float:
        """What a model is told that is to show a period."""
        return float(period) if self.tells_period else 0.0

    def view(self, camera: Camera, cam_from_world: NDArray[np.float64]) -> View:
        """A camera without distortion as the models see it; its pose is in the world. [4, 4]"""
        pose = self.training_from_world.apply_to_pose(cam_from_world)
        return View(camera.K, camera.width, camera.height, pose)

    def render(
        self,
        camera: Camera,
        cam_from_world: NDArray[np.float64],
        period: float,
        *,
        appearance_period: float | None = None,
    ) -> Prediction:
        """Render what a camera sees as of a period.

        Args:
            camera: Without distortion.
            cam_from_world: Pose in the world of the scene. [4, 4]
            period: From 0 to the last; fractional only if `is_continuous`.
            appearance_period: The one whose colours the geometry of the other is to have.

        Returns:
            The image; depth, where the method gives it, in units of the world.

        Raises:
            ConfigError: If no model claims the period, or can take the colours of another.
        """
        self.check_period(period)
        view, model = self.view(camera, cam_from_world), self.model(period)
        if appearance_period is None:
            prediction = model.render(view, self.told(period))
        else:
            self.check_appearance(appearance_period)
            prediction = model.render_split(
                view, geometry_period=period, appearance_period=appearance_period
            )
        if prediction.depth is None:
            return prediction
        return replace(prediction, depth=prediction.depth / self.training_from_world.scale)

    def check_appearance(self, period: float) -> None:
        """Refuse the colours of another period where the model does not have them apart.

        Raises:
            ConfigError: If it does not, or does not claim the period.
        """
        self.check_period(period)
        if not self.tells_period or not hasattr(self.model(period), "render_split"):
            raise ConfigError(
                f"appearance of period {period:g}",
                expected="one model of all periods that keeps geometry and colours apart",
                found=f"{self.spec.title} under strategy {self.record.strategy}",
                todo="leave it out, or open a run of chronogs under strategy joint",
            )

    def scene(self, root: Path | None = None) -> Scene:
        """The scene that the run was trained on, or ``root`` where it has moved.

        Raises:
            SceneError: If it is not there, cannot be read, or is another one.
        """
        place, found = root or Path(self.source.scene_root), "nothing"
        if place.exists():
            source = self.source
            scene = read_scene(place, format=source.scene_format, period_by=source.period_by)
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
    folder: Path, *, device: str = "cpu", plugin_path: Path | None = None, stage: int | None = None
) -> OpenRun:
    """Open the folder of a finished run, ``RUNS/<scene>/<method>-<strategy>-<preset>/seed<k>``.

    Models are loaded when they are first asked for. The scene need not be there.

    Args:
        folder: With ``run.json``.
        device: ``cpu`` or ``cuda``.
        plugin_path: Where ``module:SPEC`` is now, if it has moved.
        stage: Number of the period after which the model of a ``sequential`` run is wanted; None
            for the last.

    Raises:
        CheckpointError: If the folder has no finished run, or a file is damaged.
        ConfigError: If the method is not installed, or there is no such stage.
        BackendError: If there is no such device.
    """
    check_device(device)
    record = read_run(folder)
    if stage is not None:
        record = _at_stage(record, stage)
    if not (folder / CHECKPOINT).is_dir():
        raise CheckpointError(
            folder,
            expected="a run with a model",
            found=f"no folder {CHECKPOINT}",
            todo="open a run that bench trained, with its checkpoint",
        )
    source = _read_source(folder / SOURCE_FILE)
    for path in filter(None, (plugin_path, source.plugin_path)):
        if str(path) not in sys.path:
            sys.path.append(str(path))
    try:
        spec = load_spec(source.method)
    except ConfigError as error:
        raise ConfigError(
            source.method,
            expected=f"the method of the run, from {source.plugin_path or record.method_version}",
            found=error.found,
            todo="install it, or put the folder of its module into PYTHONPATH",
        ) from error
    if spec.runner is not None:
        raise CheckpointError(
            folder,
            expected="a run of a method that renders here",
            found=f"one of {spec.title}, which is another program",
            todo=f"open the files in its folder {CHECKPOINT} with that program",
        )
    return OpenRun(
        folder=folder,
        record=record,
        spec=spec,
        source=source,
        config=config_from_values(spec, read_config(folder)["config"]["method_config"]),
        training_from_world=Sim3.from_matrix(source.training_from_world),
        device=device,
    )


def _at_stage(record: RunRecord, stage: int) -> RunRecord:
    """The record with the periods of a stage and those before."""
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
