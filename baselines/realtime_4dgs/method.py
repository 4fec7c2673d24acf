"""realtime4DGS as a plug-in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from baselines.realtime_4dgs.config import Realtime4DGSConfig
from baselines.realtime_4dgs.model import SpacetimeModel, start_in_time
from baselines.realtime_4dgs.slicing import SHAPES
from baselines.realtime_4dgs.trainer import SpacetimeTrainer
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.gaussians.trainer import Due
from chronoscene.methods import TrainingSet, View
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.points import finite_rows


class Realtime4DGS(GaussianMethod):
    """Gaussians in space and time, of which an image shows the slice at its time.

    Source: Yang et al. 2024, "Real-time Photorealistic Dynamic Scene Representation and Rendering
    with 4D Gaussian Splatting". README.md beside this file says what differs on purpose.
    """

    name = "realtime4dgs"
    config_class = Realtime4DGSConfig
    trainer_class = SpacetimeTrainer
    shapes = SHAPES
    config: Realtime4DGSConfig
    model: SpacetimeModel

    def make_model(
        self, parameters: dict[str, Tensor], train: TrainingSet, seed: int
    ) -> SpacetimeModel:
        seen = train.point_periods[finite_rows(train.points)]
        parameters = start_in_time(parameters, seen, self.config, seed)
        return SpacetimeModel(
            parameters, periods=train.num_periods, cycle=self.config.wave_cycle, order=0
        )

    def extended_model(self, train: TrainingSet) -> SpacetimeModel:
        """Keep the model; new periods follow at the distance of the first two."""
        self.meta["first_periods"] = self.model.periods
        return self.model

    def restore_model(self, tensors: dict[str, Tensor]) -> SpacetimeModel:
        return SpacetimeModel(
            tensors,
            sh_degree=self.meta["sh_degree"],
            periods=self.meta.get("first_periods", self.meta["num_periods"]),
            cycle=self.config.wave_cycle,
        )

    def learning_rates(self, due: Due) -> Mapping[str, float]:
        assert self.trainer is not None
        config = self.config
        return {
            **super().learning_rates(due),
            "right_quats": config.rotation_lr,
            "time_means": config.time_lr * self.trainer.extent,
            "log_time_scales": config.scale_lr,
            "waves_dc": config.wave_dc_lr,
            "waves_rest": config.sh_rest_lr,
        }

    def static_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        """Gaussians that are there at the time."""
        cloud = super().static_gaussians(period, views)
        return cloud.rows(cloud.opacities > 0)
