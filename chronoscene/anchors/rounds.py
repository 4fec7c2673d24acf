"""Density control in training: statistics of the views, and rounds that change the anchors.

While the set of anchors grows, a round adds and prunes anchors every so many steps. Once growth is
over, what carries nothing is dropped, and periods come to share blocks that are alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.blocks import BlockStatistics, merge_alike
from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.contribution import used_offsets
from chronoscene.anchors.decode import pack_bits, unpack_bits
from chronoscene.anchors.density import AnchorRows, DensityStatistics, grow, prune_mask
from chronoscene.anchors.optimizer import AnchorOptimizer
from chronoscene.anchors.visibility import projected_centres
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.checkpoint import parts
from chronoscene.training.gradients import centre_gradients, centres_count
from chronoscene.training.views import is_due

_MARGIN = 1e-9
"""Shares of the training this close are equal: progress is a quotient of rounded numbers."""


class DrawnView(NamedTuple):
    """A training view as a step drew it."""

    view: TrainingView
    row: int
    """Row of its varying features."""
    mask: Tensor | None
    """Pixels of the photo that count; None if all do. bool [H, W]"""
    visible: Tensor
    """Anchors that were decoded. int64 [M]"""
    positions: Tensor
    """Places of the Gaussians, of M * k, that are switched on. int64 [L]"""
    opacities: Tensor
    """[L]"""
    info: RasterInfo
    block_gradient: Tensor | None
    """Gradient of the blocks of the visible anchors, if there are any. [M, Fv]"""


@dataclass(eq=False)
class DensityControl:
    """Statistics of the views, and the rounds that change the anchors of a model."""

    config: AnchorConfig
    optimizer: AnchorOptimizer
    """Holds the model."""
    train: TrainingSet
    voxel_size: float
    """Smallest growth cell in training units."""
    feature_rows: NDArray[np.int64]
    """Row of the varying features of each view. [V]"""
    merge_share: float
    """Share by which the loss may rise where periods come to share blocks; 0: they share none."""
    generator: np.random.Generator
    """Decides where anchors grow at random."""
    statistics: DensityStatistics | None = None
    block_statistics: BlockStatistics | None = None
    _dropped: bool = False

    def collect(self, drawn: DrawnView, loss: float, done: float) -> None:
        """Add a view to the statistics, if they count now.

        Args:
            drawn: The view, after the backward pass.
            loss: Of the view.
            done: Share of the training that is over once this step is done.
        """
        config, model = self.config, self.optimizer.model
        if not config.statistics_from + _MARGIN < done < config.density_until - _MARGIN:
            return
        if self.statistics is None:
            self.statistics = self._new_statistics()
        view, mask, info = drawn.view, drawn.mask, drawn.info
        radii, counted = info.radii[0], None
        if mask is not None:
            radii = radii * centres_count(info.means2d[0].detach(), mask)[:, None]
            counted = centres_count(projected_centres(model.anchors[drawn.visible], view), mask)
        facts = (drawn.positions, drawn.opacities.detach(), radii, centre_gradients(info))
        self.statistics.update(drawn.visible, *facts, view.width, view.height, counted)
        if self.merge_share and model.block_rows.shape[1] > 1:
            self._collect_blocks(drawn, loss)

    def _collect_blocks(self, drawn: DrawnView, loss: float) -> None:
        if self.block_statistics is None:
            self.block_statistics = self._new_block_statistics()
        visible, pixels = drawn.visible, drawn.view.width * drawn.view.height
        if drawn.mask is not None:
            pixels = int(drawn.mask.sum())
        shown = torch.zeros(len(visible), dtype=torch.bool, device=visible.device)
        shown[drawn.positions // self.optimizer.model.layout.offsets] = True
        if (gradient := drawn.block_gradient) is not None:
            self.block_statistics.update(
                visible, drawn.row, gradient, shown, loss=loss, pixels=pixels
            )

    def _new_statistics(self) -> DensityStatistics:
        model = self.optimizer.model
        return DensityStatistics(len(model), model.layout.offsets, model.device)

    def _new_block_statistics(self) -> BlockStatistics:
        model = self.optimizer.model
        return BlockStatistics(len(model), model.layout.num_periods, model.device)

    def round(self, index: int, views: int, done: float) -> bool:
        """Change the anchors if it is time to; return True if their rows have changed.

        Args:
            index: Number of views seen before this step.
            views: Number of views of this step.
            done: Share of the training that is over once this step is done.
        """
        ends = is_due(index, views, self.config.density_interval)
        resized = self._densify_if_due(ends, done) or self._drop_if_due(done)
        return self._merge_if_due(ends, done) or resized

    def _densify_if_due(self, ends: bool, done: float) -> bool:
        """Grow and prune; return True if it was time to."""
        config = self.config
        if done >= config.density_until - _MARGIN:
            self.statistics = None
            return False
        sign = 1.0 if config.first_round == "after" else -1.0
        started = done > config.density_from + sign * _MARGIN
        if not started or not ends or self.statistics is None:
            return False
        self.optimizer.flush()
        self._grow(self.statistics)
        self._prune(self.statistics)
        return True

    def _grow(self, statistics: DensityStatistics) -> None:
        model = self.optimizer.model
        rows = AnchorRows(*(getattr(model, name).detach() for name in AnchorRows._fields))
        blocks = model.blocks.detach()[model.block_rows].flatten(1)
        rows = rows._replace(features=torch.cat([rows.features, blocks], dim=1))
        new = grow(rows, statistics, self.config, self.voxel_size, self.generator)
        self.optimizer.add(new)
        statistics.extend(len(new.anchors))
        if self.block_statistics is not None:
            self.block_statistics.extend(len(new.anchors))

    def _prune(self, statistics: DensityStatistics) -> None:
        """Drop anchors and bound the scales. A model is never left without any anchor."""
        keep = prune_mask(statistics, self.config)
        if not keep.all() and keep.any():
            self._keep(keep)
            statistics.keep(keep)
        with torch.no_grad():
            self.optimizer.model.log_scales[:, 3:].clamp_(max=self.config.max_log_scale)

    def _keep(self, mask: Tensor) -> None:
        self.optimizer.keep(mask)
        if self.block_statistics is not None:
            self.block_statistics.keep(mask)

    def _drop_if_due(self, done: float) -> bool:
        """Drop what carries nothing, once growth is over; return True if it was time to."""
        config, model = self.config, self.optimizer.model
        if self._dropped or not config.unused_share or done < config.density_until - _MARGIN:
            return False
        self._dropped = True
        self.optimizer.flush()
        rows = self.feature_rows.tolist()
        used = used_offsets(model, self.train.views, rows, config.unused_share)
        if model.used_offsets is not None:
            used &= unpack_bits(model.used_offsets, model.layout.offsets)
        model.used_offsets = pack_bits(used)
        self._keep(used.any(1))
        return True

    @torch.no_grad()
    def _merge_if_due(self, ends: bool, done: float) -> bool:
        """Let periods share blocks, once growth is over; return True if it was time to."""
        statistics, model = self.block_statistics, self.optimizer.model
        if statistics is None:
            return False
        if done < self.config.density_until - _MARGIN:
            if ends:
                statistics.fade()
            return False
        self.block_statistics = None
        self.optimizer.flush()
        first, merged = merge_alike(model.blocks[model.block_rows], statistics, self.merge_share)
        model.blocks[model.block_rows] = merged
        self.optimizer.keep_blocks(model.block_rows.gather(1, first))
        return True

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return everything that later rounds depend on: tensors, and what JSON can hold."""
        tensors: dict[str, Tensor] = {}
        for prefix in ("statistics", "block_statistics"):
            if (counters := getattr(self, prefix)) is not None:
                tensors |= {f"{prefix}.{name}": t for name, t in counters.state().items()}
        generator = self.generator.bit_generator.state
        return tensors, {"dropped": self._dropped, "growth_generator": generator}

    def load_state(self, tensors: Mapping[str, Tensor], values: Mapping[str, Any]) -> None:
        """Go on from what `state` gave, with the model as it was then."""
        self.statistics = self.block_statistics = None
        if counters := parts(tensors, "statistics"):
            self.statistics = self._new_statistics()
            self.statistics.load_state(counters)
        if counters := parts(tensors, "block_statistics"):
            self.block_statistics = self._new_block_statistics()
            self.block_statistics.load_state(counters)
        self._dropped = values["dropped"]
        self.generator.bit_generator.state = values["growth_generator"]
