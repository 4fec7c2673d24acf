"""The tensors of a model in training: Adam, the rows of visible anchors, rows that come and go."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from chronoscene.anchors.blocks import decay_to_mean, own_blocks
from chronoscene.anchors.density import AnchorRows
from chronoscene.anchors.model import FIXED, PER_ANCHOR, TABLES, AnchorModel
from chronoscene.training.checkpoint import parts
from chronoscene.training.optimizers.adam import ONE_VIEW, Adam, DenseTable, Pace, apply_updates
from chronoscene.training.optimizers.row_adam import (
    RowAdam,
    fetch_together,
    make_table,
    step_together,
)
from chronoscene.training.optimizers.summing import add_gradients, use_sum


class SeenAnchors(NamedTuple):
    """The anchors that a view sees, as it learns from them."""

    model: AnchorModel
    """A model of one period, whose trained tensors collect the gradients of this view alone."""
    rows: dict[str, Tensor]
    """Rows of each table that the model has copies of. int64 [M]"""
    row: int
    """Row of the global features."""

    def gradients(self) -> dict[str, Tensor]:
        """Return all gradients that there are, by the names of their tensors."""
        tensors = self.model.tensors()
        return {name: t.grad for name, t in tensors.items() if t.grad is not None}


class AnchorOptimizer:
    """Adam for a model, of which each step reads the rows of the visible anchors.

    Args:
        model: Trained in place; `snapshot` gives its present state.
        trained: Names of the tensors to train.
        pace: By how many views the gradients of a step are.
    """

    def __init__(self, model: AnchorModel, trained: Collection[str], pace: Pace = ONE_VIEW) -> None:
        self.model = model.requires_grad()
        tensors = {n: t for n, t in model.tensors().items() if n in trained and t.numel() > 0}
        self.trained = tuple(tensors)
        """Names of the tensors that are trained and not empty."""
        self.adam = Adam({name: t for name, t in tensors.items() if name not in TABLES}, pace)
        self.tables: dict[str, RowAdam | DenseTable] = {
            "offsets": make_table(model.offsets, pace),
            "features": make_table(model.features, pace),
            "blocks": make_table(model.blocks, pace),
            # Culling reads the scales of all anchors in every step.
            "log_scales": DenseTable(model.log_scales, pace),
        }
        self._seen_layout = replace(model.layout, num_periods=1)

    def seen(self, visible: Tensor, row: int) -> SeenAnchors:
        """Return the visible anchors, with one row of the features that vary.

        Several threads may ask at a time.
        """
        model = self.model
        if model.layout.period_dim:
            blocks = model.block_rows[:, row].index_select(0, visible)
            rows = own_blocks(len(visible), 1, visible.device)
        else:
            rows = model.block_rows[visible]
            blocks = rows.flatten()
        wanted = dict.fromkeys(PER_ANCHOR, visible) | {"blocks": blocks}
        fetched = self._fetch(wanted)
        heads = {n: type(head)(*map(_alias, head)) for n, head in model.heads.items()}
        seen = type(model)(
            self._seen_layout,
            anchors=model.anchors.index_select(0, visible),
            **fetched,
            block_rows=rows,
            global_features=_alias(model.global_features[row : row + 1]),
            heads=heads,
            used_offsets=None if model.used_offsets is None else model.used_offsets[visible],
        )
        return SeenAnchors(seen, wanted, row)

    def _fetch(self, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Fetch rows of each table, by name."""
        found, lazy = {}, []
        for name, rows in wanted.items():
            table = self.tables[name]
            if isinstance(table, RowAdam):
                lazy.append((name, table, rows))
            else:
                found[name] = table.fetch(rows)
        copies = fetch_together([(table, rows) for _, table, rows in lazy]) if lazy else []
        return found | {name: copy for (name, _, _), copy in zip(lazy, copies, strict=True)}

    @torch.no_grad()
    def learn_from(self, views: Sequence[SeenAnchors]) -> None:
        """Let `step` use the sum of the gradients of some views."""
        total: dict[str, Tensor] = {}
        for view in views:
            own = view.gradients()
            row = own.pop("global_features", None)
            add_gradients(total, {name: own[name] for name in own.keys() & self.adam.params.keys()})
            if row is not None and row.numel():
                every = torch.zeros_like(self.model.global_features)
                every[view.row] = row[0]
                add_gradients(total, {"global_features": every})
        for name, gradient in total.items():
            self.adam.params[name].grad = gradient
        for name, table in self.tables.items():
            use_sum(table, [(view.rows[name], getattr(view.model, name)) for view in views])

    def step(self, rates: Mapping[str, float], *, resized: bool) -> None:
        """Do one step of Adam with the gradients of `learn_from`.

        After a round only the MLPs and global features move, as in the official code, where the
        anchors then have new tensors without gradients.

        Args:
            rates: Learning rate of each tensor.
            resized: True if the rows of the anchors have changed since the backward pass.
        """
        updates, lazy = self.adam.updates(rates), []
        if not resized:
            for name, table in self.tables.items():
                if name not in rates:
                    continue
                if isinstance(table, RowAdam):
                    lazy.append((table, rates[name]))
                else:
                    updates += table.updates(rates[name])
        step_together(lazy)
        apply_updates(updates)

    def flush(self) -> None:
        """Bring the rows of all anchors up to date."""
        for table in self.tables.values():
            table.flush()

    def snapshot(self) -> AnchorModel:
        """Return the model up to date: in `model`, anchors that no view saw lately lag behind."""
        tensors = self.model.tensors()
        tensors |= {name: table.snapshot() for name, table in self.tables.items()}
        return self.model.from_tensors(self.model.layout, tensors)

    def add(self, new: AnchorRows) -> None:
        """Add anchors, whose features are the base feature and the blocks of all periods."""
        model, layout = self.model, self.model.layout
        base, blocks = new.features.tensor_split([layout.base_dim], dim=1)
        new = new._replace(features=base)
        for name in PER_ANCHOR:
            setattr(model, name, self.tables[name].extend(getattr(new, name)))
        if layout.period_dim:
            blocks = blocks.unflatten(1, (-1, layout.period_dim))  # [N, T, Fv]
            rows = len(model.blocks) + own_blocks(len(blocks), blocks.shape[1], model.device)
            model.blocks = self.tables["blocks"].extend(blocks.flatten(0, 1))
            model.block_rows = torch.cat([model.block_rows, rows])
        else:
            model.block_rows = model.anchors.new_empty(len(model) + len(base), 0).long()
        model.anchors = torch.cat([model.anchors, new.anchors])
        if model.used_offsets is not None:
            every = model.used_offsets.new_full((len(new.anchors),), -1)
            model.used_offsets = torch.cat([model.used_offsets, every])

    def keep(self, mask: Tensor) -> None:
        """Forget the anchors outside a mask. bool [A]"""
        model = self.model
        for name in PER_ANCHOR:
            setattr(model, name, self.tables[name].keep(mask))
        model.anchors = model.anchors[mask]
        self.keep_blocks(model.block_rows[mask])
        if model.used_offsets is not None:
            model.used_offsets = model.used_offsets[mask]

    @torch.no_grad()
    def decay_blocks(self, periods: Tensor, share: float) -> None:
        """Move the blocks of each anchor at some periods towards their mean, by a share."""
        self.tables["blocks"].flush()
        decay_to_mean(self.model.blocks, self.model.block_rows[:, periods], share)

    def keep_blocks(self, block_rows: Tensor) -> None:
        """Give the anchors these blocks, and forget those that no anchor has. int64 [A, T]"""
        model = self.model
        used = torch.zeros(len(model.blocks), dtype=torch.bool, device=model.device)
        used[block_rows] = True
        model.blocks = self.tables["blocks"].keep(used)
        model.block_rows = (used.cumsum(0) - 1)[block_rows]

    def state(self) -> dict[str, Tensor]:
        """Return everything that later steps depend on, by name."""
        tensors = {f"model.{n}": t for n, t in self.model.tensors().items() if n not in self.tables}
        sources = {f"table.{name}": table.state() for name, table in self.tables.items()}
        sources["adam"] = self.adam.state()
        for prefix, source in sources.items():
            tensors |= {f"{prefix}.{name}": tensor for name, tensor in source.items()}
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from what `state` gave, for a model of the same layout."""
        model, stored = self.model, parts(tensors, "model")
        for name in stored.keys() & set(FIXED):
            setattr(model, name, stored[name].to(model.device))
        for name, tensor in model.tensors().items():
            if name not in FIXED and name not in self.tables:
                tensor.copy_(stored[name])
        for name, table in self.tables.items():
            setattr(model, name, table.load_state(parts(tensors, f"table.{name}")))
        self.adam.load_state(parts(tensors, "adam"))


def _alias(tensor: Tensor) -> Tensor:
    """Return a leaf with the same numbers in the same memory, and a gradient of its own."""
    return tensor.detach().requires_grad_()
