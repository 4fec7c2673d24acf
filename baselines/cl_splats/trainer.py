"""Training of CL-Splats: one period after the other, of each what has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from baselines.cl_splats.config import CLSplatsConfig
from baselines.cl_splats.model import STRAYS, PeriodModel
from chronoscene.gaussians.trainer import Due, GaussianTrainer
from chronoscene.methods import StepReport, TrainingSet
from chronoscene.training.checkpoint import TrainingState, parts
from chronoscene.training.views import is_due

_EXPOSURES = "exposures"  # Name of the stored transforms of all periods


class CLSplatsTrainer(GaussianTrainer):
    """Trains what `PeriodModel` has in training.

    Of several periods, each gets a share of the steps by the number of its views.
    """

    config: CLSplatsConfig
    model: PeriodModel
    begin_period: Callable[[TrainingSet], object]
    """Puts what has changed in a period into training."""
    stage: int = 0
    """Number of the period in training among those that have views."""

    def __post_init__(self) -> None:
        self.stages = by_period(self.train)
        counts = np.cumsum([0, *(len(stage.views) for stage in self.stages)])
        self.bounds = counts / counts[-1]
        """Progress at which periods begin, and the end."""
        self.train = self.stages[0]
        super().__post_init__()

    def step(self, index: int, progress: float) -> StepReport:
        # A third of three steps is a third, however it is rounded.
        due = int((progress + 1e-9 >= self.bounds[1:-1]).sum())
        while self.stage < due:
            exposure = self.exposure.by_period()
            self.begin_period(self.stages[self.stage + 1])
            self._enter(self.stage + 1, index)
            if exposure is not None:
                self.exposure.begin(exposure)
        start, end = self.bounds[self.stage : self.stage + 2]
        report = super().step(index, max(progress - start, 0.0) / (end - start))
        strays = is_due(index, report.views, self.config.stray_interval)
        if len(self.model.spheres) and strays:
            self._prune_strays()
        return replace(report, primitives=len(self.model) + len(self.model.kept["means"]))

    def _enter(self, stage: int, begin: int) -> None:
        """Train on the views of another period from a step on; everything begins anew."""
        self.stage, self.train = stage, self.stages[stage]
        self.model.period = self.train.views[0].period
        self.timeline = self.timeline_class(self.config, begin)
        self.begin_views()
        self.begin()

    @torch.no_grad()
    def _prune_strays(self) -> None:
        """Count the Gaussians outside of all spheres, and prune those that stay there."""
        p = self.model.parameters
        x, y, z = p["means"].unbind(-1)
        outside = torch.ones_like(x, dtype=torch.bool)
        for a, b, c, radius in self.model.spheres:
            outside &= (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 > radius**2
        strays = torch.where(outside, p[STRAYS] + 1, 0.0)
        keep = strays < self.config.stray_checks
        p[STRAYS].copy_(strays)
        for name in list(p):
            p[name] = self.optimizer.keep(name, keep)
        self.statistics.sums = self.statistics.sums[keep]
        self.statistics.views = self.statistics.views[keep]

    def _update(self, due: Due) -> None:
        """Opacities are reset in the first period only, as released."""
        super()._update(replace(due, reset=due.reset and not len(self.model.kept["means"])))

    def state(self) -> TrainingState:
        state = super().state()
        state.tensors.update({f"kept.{name}": t for name, t in self.model.kept.items()})
        state.tensors["spheres"] = self.model.spheres
        exposure = self.exposure.by_period()  # also of periods that are over
        if exposure is not None:
            state.tensors[_EXPOSURES] = exposure
        state.values.update(stage=self.stage, stage_begin=self.timeline.begin)
        return state

    def load_state(self, state: TrainingState) -> None:
        device = self.background.device
        self._enter(state.values["stage"], state.values["stage_begin"])
        kept = parts(state.tensors, "kept")
        self.model.keep({name: tensor.to(device) for name, tensor in kept.items()})
        self.model.spheres = state.tensors["spheres"].to(device)
        if _EXPOSURES in state.tensors:
            self.exposure.begin(state.tensors[_EXPOSURES].to(device))
        super().load_state(state)


def by_period(train: TrainingSet) -> list[TrainingSet]:
    """The views of one period after the other, for each a set."""
    stages = []
    for period in sorted({view.period for view in train.views}):
        own = [i for i, view in enumerate(train.views) if view.period == period]
        stages.append(train.with_views(own))
    return stages
