"""One training step of a model with anchors.

Every schedule follows the progress of the training. Gradients come from kernels that reduce in a
fixed order or from elementwise torch, and random numbers only from the seed, so a seed gives the
same bytes for any number of threads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.blocks import BlockStatistics, merge_alike, own_blocks
from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.contribution import used_offsets
from chronoscene.anchors.decode import pack_bits, unpack_bits
from chronoscene.anchors.density import AnchorRows, DensityStatistics, grow, prune_mask
from chronoscene.anchors.model import FIXED, PER_ANCHOR, TABLES, AnchorModel
from chronoscene.anchors.visibility import projected_centres
from chronoscene.methods import Skipped, StepReport, TrainingSet, TrainingView
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.checkpoint import TrainingState, parts
from chronoscene.training.devices import to_device
from chronoscene.training.drawing import camera_centre_tensor, draw, step_background
from chronoscene.training.exposure import Exposure
from chronoscene.training.gradients import centre_gradients, centres_count, collect_gradients
from chronoscene.training.losses import mean_volume
from chronoscene.training.optimizers.adam import Adam, DenseTable
from chronoscene.training.optimizers.row_adam import make_table
from chronoscene.training.photometric import photometric_loss
from chronoscene.training.schedules import log_linear
from chronoscene.training.views import ViewSampler

_COOLED = 0.1  # Factor of the learning rates at the end of a cooldown
_MARGIN = 1e-9
"""Shares of the training this close are equal: progress is a quotient of rounded numbers."""


@dataclass(eq=False)
class AnchorTrainer:
    """Trains a model on the views of a training set."""

    config: AnchorConfig
    model: AnchorModel
    """Trained in place; `snapshot` gives its present state."""
    train: TrainingSet
    _: KW_ONLY
    voxel_size: float
    """Smallest growth cell in training units."""
    seed: int
    """All random choices follow from it."""
    rates: Mapping[str, tuple[float, float]]
    """Learning rates by tensor name."""
    feature_rows: NDArray[np.int64]
    """Which of the features that vary each view has, mostly its period. [V]"""
    merge_share: float = 0.0
    """By how much the loss may rise where periods come to share blocks; 0: they share none."""

    def __post_init__(self) -> None:
        model, train, seed = self.model.requires_grad(), self.train, self.seed
        layout, tensors = model.layout, model.tensors()
        trained = {n: t for n, t in tensors.items() if n in self.rates and t.numel() > 0}
        self.rates = {name: self.rates[name] for name in trained}
        self.tables = {
            "offsets": make_table(model.offsets),
            "features": make_table(model.features),
            "blocks": make_table(model.blocks),
            # Culling reads the scales of all anchors in every step.
            "log_scales": DenseTable(model.log_scales),
        }
        self.optimizer = Adam({n: t for n, t in trained.items() if n not in TABLES})
        self._seen_layout = replace(layout, num_periods=1)
        self._one_period = torch.ones(1, device=model.device)
        self.background = torch.from_numpy(train.background).to(model.device)
        self.sampler = ViewSampler(len(train.views), seed, train.expect)
        self.exposure = Exposure(self.config.exposure, train, model.device)
        self.growth_generator = np.random.default_rng((seed, 1))
        self.statistics: DensityStatistics | None = None
        self.block_statistics: BlockStatistics | None = None
        self._dropped = False

    def step(self, index: int, progress: float) -> StepReport:
        """Render one training view, learn from it, and grow and prune where a round is due."""
        done = self._progress_after(index, progress)
        position = self.sampler.next()
        view = self.train.views[position]
        photo, mask = self.train.load_image(position), self.train.load_mask(position)
        loss, skipped = self._learn(view, photo, mask, position, done)
        resized = self._densify_if_due(index, done) or self._drop_if_due(done)
        resized |= self._merge_if_due(index, done)
        if skipped is None:
            self._update(done, resized=resized)
        self.optimizer.zero_grad()
        return StepReport(loss, len(self.model), skipped)

    def _progress_after(self, index: int, progress: float) -> float:
        """Share of the training that is over once this step is done."""
        return progress * (index + 1) / index if index > 0 else 1.0 / self.config.iterations

    def _learn(
        self,
        view: TrainingView,
        photo: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        position: int,
        done: float,
    ) -> tuple[float, Skipped | None]:
        """Loss, and why the step must be skipped, if it must."""
        visible, row = self.model.visible(view), int(self.feature_rows[position])
        everything = torch.arange(len(visible), device=visible.device)
        splats, positions = self._seen(visible, row).decode_active(
            self._one_period, camera_centre_tensor(view, visible.device), everything
        )
        background = step_background(
            self.background, self.config, seed=self.seed, number=self.sampler.drawn
        )
        raster = draw(
            splats,
            view,
            background,
            near_plane=self.config.near_plane,
            antialiased=self.config.antialiased,
            absgrad=self.config.absgrad,
            check_finite=False,
        )
        target = to_device(photo, self.model.device)
        counts = None if mask is None else to_device(mask.copy(), self.model.device)
        image, weight = self.exposure.apply(raster.image[0], position), self.config.ssim_weight
        loss = photometric_loss(image, target, ssim_weight=weight, mask=counts)
        if self.config.scale_weight:
            volume = mean_volume(splats.scales, splats.opacities)
            loss = loss + self.config.scale_weight * volume
        optimizers = [self.optimizer, *self.tables.values(), *self.exposure.tables]
        value, skipped = collect_gradients(loss, raster.info, optimizers, counts)
        collects = (
            self.config.statistics_from + _MARGIN < done < self.config.density_until - _MARGIN
        )
        if collects and skipped is None:
            self._collect(view, visible, positions, splats.opacities, raster.info, counts)
            if self.merge_share and self.model.block_rows.shape[1] > 1:
                self._collect_blocks(visible, row, positions, value, view)
        return value, skipped

    def _seen(self, visible: Tensor, row: int) -> AnchorModel:
        """The visible anchors with one of the features that vary: a model of a single period."""
        tables, model = self.tables, self.model
        blocks = rows = model.block_rows[visible]
        if model.layout.period_dim:
            blocks, rows = rows[:, row], own_blocks(len(visible), 1).to(rows)
        return type(model)(
            self._seen_layout,
            anchors=model.anchors[visible],
            offsets=tables["offsets"].fetch(visible),
            features=tables["features"].fetch(visible),
            blocks=tables["blocks"].fetch(blocks.flatten()),
            block_rows=rows,
            log_scales=tables["log_scales"].fetch(visible),
            global_features=model.global_features[row : row + 1],
            heads=model.heads,
            used_offsets=None if model.used_offsets is None else model.used_offsets[visible],
        )

    def state(self) -> TrainingState:
        """Everything that the steps to come depend on."""
        tensors = {f"model.{n}": t for n, t in self.model.tensors().items() if n not in self.tables}
        sources = {f"table.{name}": table.state() for name, table in self.tables.items()}
        sources["adam"] = self.optimizer.state()
        sources["exposure"] = self.exposure.state()
        if self.statistics is not None:
            sources["statistics"] = self.statistics.state()
        if self.block_statistics is not None:
            sources["block_statistics"] = self.block_statistics.state()
        for prefix, source in sources.items():
            tensors |= {f"{prefix}.{name}": tensor for name, tensor in source.items()}
        values = {
            "views_drawn": self.sampler.drawn,
            "dropped": self._dropped,
            "growth_generator": self.growth_generator.bit_generator.state,
        }
        return TrainingState(tensors, values)

    @torch.no_grad()
    def load_state(self, state: TrainingState) -> None:
        """Go on from what `state` gave, in a trainer that was made alike."""
        model, stored = self.model, parts(state.tensors, "model")
        for name in stored.keys() & set(FIXED):
            setattr(model, name, stored[name].to(model.device))
        for name, tensor in model.tensors().items():
            if name not in FIXED and name not in self.tables:
                tensor.copy_(stored[name])
        for name, table in self.tables.items():
            setattr(model, name, table.load_state(parts(state.tensors, f"table.{name}")))
        self.optimizer.load_state(parts(state.tensors, "adam"))
        self.exposure.load_state(parts(state.tensors, "exposure"))
        self.statistics = None
        if counters := parts(state.tensors, "statistics"):
            self.statistics = self._new_statistics()
            self.statistics.load_state(counters)
        self.block_statistics = None
        if counters := parts(state.tensors, "block_statistics"):
            self.block_statistics = self._new_block_statistics()
            self.block_statistics.load_state(counters)
        self.sampler.drawn = state.values["views_drawn"]
        self._dropped = state.values["dropped"]
        self.growth_generator.bit_generator.state = state.values["growth_generator"]

    def snapshot(self) -> AnchorModel:
        """The model up to date: in `model`, anchors that no view saw lately lag behind."""
        tensors = self.model.tensors()
        tensors |= {name: table.snapshot() for name, table in self.tables.items()}
        return self.model.from_tensors(self.model.layout, tensors)

    def _collect(
        self,
        view: TrainingView,
        visible: Tensor,
        positions: Tensor,
        opacities: Tensor,
        info: RasterInfo,
        mask: Tensor | None,
    ) -> None:
        if self.statistics is None:
            self.statistics = self._new_statistics()
        radii, counted = info.radii[0], None
        if mask is not None:
            radii = radii * centres_count(info.means2d[0].detach(), mask)[:, None]
            counted = centres_count(projected_centres(self.model.anchors[visible], view), mask)
        facts = (positions, opacities.detach(), radii, centre_gradients(info))
        self.statistics.update(visible, *facts, view.width, view.height, counted)

    def _new_statistics(self) -> DensityStatistics:
        return DensityStatistics(len(self.model), self.model.layout.offsets, self.model.device)

    def _densify_if_due(self, index: int, done: float) -> bool:
        """Grow and prune; whether the rows of the anchors changed."""
        config = self.config
        if done >= config.density_until - _MARGIN:
            self.statistics = None
            return False
        sign = 1.0 if config.first_round == "after" else -1.0
        started = done > config.density_from + sign * _MARGIN
        if not started or (index + 1) % config.density_interval or self.statistics is None:
            return False
        for table in self.tables.values():
            table.flush()
        self._grow(self.statistics)
        self._prune(self.statistics)
        return True

    def _grow(self, statistics: DensityStatistics) -> None:
        model = self.model
        rows = AnchorRows(*(getattr(model, name).detach() for name in AnchorRows._fields))
        blocks = model.blocks.detach()[model.block_rows].flatten(1)
        rows = rows._replace(features=torch.cat([rows.features, blocks], dim=1))
        new = grow(rows, statistics, self.config, self.voxel_size, self.growth_generator)
        base, blocks = new.features.split([model.layout.base_dim, blocks.shape[1]], dim=1)
        new = new._replace(features=base)
        for name in PER_ANCHOR:
            setattr(model, name, self.tables[name].extend(getattr(new, name)))
        if model.layout.period_dim:
            self._add_blocks(blocks.unflatten(1, (-1, model.layout.period_dim)))
        else:
            model.block_rows = model.anchors.new_empty(len(rows.anchors) + len(base), 0).long()
        model.anchors = torch.cat([model.anchors, new.anchors])
        if model.used_offsets is not None:
            every = model.used_offsets.new_full((len(new.anchors),), -1)
            model.used_offsets = torch.cat([model.used_offsets, every])
        statistics.extend(len(new.anchors))
        if self.block_statistics is not None:
            self.block_statistics.extend(len(new.anchors))

    def _add_blocks(self, blocks: Tensor) -> None:
        """Of new anchors. [N, T, Fv]"""
        model, first = self.model, len(self.model.blocks)
        values, rows = blocks.flatten(0, 1), own_blocks(*blocks.shape[:2]).to(model.device)
        model.blocks = self.tables["blocks"].extend(values)
        model.block_rows = torch.cat([model.block_rows, first + rows])

    def _prune(self, statistics: DensityStatistics) -> None:
        """Drop anchors and bound the scales. A model is never left without any anchor."""
        keep = prune_mask(statistics, self.config)
        if not keep.all() and keep.any():
            self._keep(keep)
            statistics.keep(keep)
        with torch.no_grad():
            self.model.log_scales[:, 3:].clamp_(max=self.config.max_log_scale)

    def _keep(self, mask: Tensor) -> None:
        """Forget the anchors outside a mask. bool [A]"""
        model = self.model
        for name in PER_ANCHOR:
            setattr(model, name, self.tables[name].keep(mask))
        model.anchors = model.anchors[mask]
        self._keep_blocks(model.block_rows[mask])
        if self.block_statistics is not None:
            self.block_statistics.keep(mask)
        if model.used_offsets is not None:
            model.used_offsets = model.used_offsets[mask]

    def _keep_blocks(self, block_rows: Tensor) -> None:
        """Forget the blocks that no anchor has."""
        model = self.model
        used = torch.zeros(len(model.blocks), dtype=torch.bool, device=model.device)
        used[block_rows] = True
        model.blocks = self.tables["blocks"].keep(used)
        model.block_rows = (used.cumsum(0) - 1)[block_rows]

    def _collect_blocks(
        self, visible: Tensor, row: int, positions: Tensor, loss: float, view: TrainingView
    ) -> None:
        if self.block_statistics is None:
            self.block_statistics = self._new_block_statistics()
        drawn = torch.zeros(len(visible), dtype=torch.bool, device=visible.device)
        drawn[positions // self.model.layout.offsets] = True
        for gradient in self.tables["blocks"].gradients():
            self.block_statistics.update(
                visible, row, gradient, drawn, loss=loss, pixels=view.width * view.height
            )

    def _new_block_statistics(self) -> BlockStatistics:
        model = self.model
        return BlockStatistics(len(model), model.layout.num_periods, model.device)

    @torch.no_grad()
    def _merge_if_due(self, index: int, done: float) -> bool:
        """Once growth is over, let periods share blocks that are alike; whether they now do."""
        statistics, model = self.block_statistics, self.model
        if statistics is None:
            return False
        if done < self.config.density_until - _MARGIN:
            if (index + 1) % self.config.density_interval == 0:
                statistics.fade()
            return False
        self.block_statistics = None
        for table in self.tables.values():
            table.flush()
        first, merged = merge_alike(model.blocks[model.block_rows], statistics, self.merge_share)
        model.blocks[model.block_rows] = merged
        self._keep_blocks(model.block_rows.gather(1, first))
        return True

    def _drop_if_due(self, done: float) -> bool:
        """Once growth is over, drop what carries nothing; whether the rows of the anchors
        changed."""
        config = self.config
        if self._dropped or not config.unused_share or done < config.density_until - _MARGIN:
            return False
        self._dropped, model = True, self.model
        for table in self.tables.values():
            table.flush()
        used = used_offsets(
            model, self.train.views, self.feature_rows.tolist(), config.unused_share
        )
        if model.used_offsets is not None:
            used &= unpack_bits(model.used_offsets, model.layout.offsets)
        model.used_offsets = pack_bits(used)
        self._keep(used.any(1))
        return True

    def _update(self, done: float, *, resized: bool) -> None:
        """Adam. After a round only the MLPs and global features move, as in the official code,
        where the anchors then have new tensors without gradients."""
        rates = {name: log_linear(done, *rate) for name, rate in self.rates.items()}
        if cooldown := self.config.cooldown:
            factor = log_linear(1.0 - (1.0 - done) / cooldown, 1.0, _COOLED)
            rates = {name: rate * factor for name, rate in rates.items()}
        self.optimizer.step(rates)
        self.exposure.step(done)
        if not resized:
            for name, table in self.tables.items():
                if name in rates:
                    table.step(rates[name])
