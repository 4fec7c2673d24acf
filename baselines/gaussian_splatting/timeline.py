"""What is due at which step."""

from __future__ import annotations

from dataclasses import dataclass

from baselines.gaussian_splatting.config import GaussianSplattingConfig
from chronoscene.training.schedule import log_linear


@dataclass(frozen=True, slots=True)
class Due:
    """What one training step has to do."""

    moment: int
    """Iteration of the schedule, from 1."""
    sh_degree: int
    position_lr: float
    """Before it is multiplied by the extent of the cameras."""
    collect: bool
    """Whether the gradients of this step count for the next round of densification."""
    densify: bool
    prune_large: bool
    reset: bool


class Timeline:
    """Turns steps and progress into what is due, each event once."""

    def __init__(self, config: GaussianSplattingConfig) -> None:
        self.config = config
        self._last_moment = 0

    def at(self, index: int, progress: float) -> Due:
        """What is due at a step.

        Args:
            index: Steps done before.
            progress: Share of the training done before, 0..1.
        """
        config = self.config
        length = config.schedule_length if config.stretch else config.iterations
        moment = round(progress * length) + 1
        # A squeezed schedule jumps over moments, so what counts is that a multiple was passed.
        passed_reset = moment // config.reset_interval > self._last_moment // config.reset_interval
        growing = moment < config.densify_until
        self._last_moment = moment
        return Due(
            moment=moment,
            sh_degree=min(config.sh_degree, moment // config.sh_interval),
            position_lr=log_linear(
                moment / config.schedule_length,
                config.position_lr_initial,
                config.position_lr_final,
            ),
            collect=growing,
            densify=growing
            and moment > config.densify_from
            and (index + 1) % config.densify_interval == 0,
            prune_large=moment > config.prune_large_from,
            reset=growing and passed_reset,
        )
