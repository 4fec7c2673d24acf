"""The tensors of a model in training: Adam, the rows of visible anchors, rows that come and go."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from chronoscene.anchors.blocks import own_blocks
from chronoscene.anchors.density import AnchorRows
from chronoscene.anchors.model import FIXED, PER_ANCHOR, TABLES, AnchorModel
from chronoscene.training.checkpoint import parts
from chronoscene.training.optimizers.adam import Adam, DenseTable, apply_updates
from chronoscene.training.optimizers.row_adam import (
    RowAdam,
    fetch_together,
    make_table,
    step_together,
)


class AnchorOptimizer:
    """Adam for a model, of which each step reads the rows of the visible anchors.

    Args:
        model: Trained in place; `snapshot` gives its present state.
        trained: Names of the tensors to train.
    """

    def __init__(self, model: AnchorModel, trained: Collection[str]) -> None:
        self.model = model.requires_grad()
        tensors = {n: t for n, t in model.tensors().items() if n in trained and t.numel() > 0}
        self.trained = tuple(tensors)
        """Names of the tensors that are trained and not empty."""
        self.adam = Adam({name: t for name, t in tensors.items() if name not in TABLES})
        self.tables: dict[str, RowAdam | DenseTable] = {
            "offsets": make_table(model.offsets),
            "features": make_table(model.features),
            "blocks": make_table(model.blocks),
            # Culling reads the scales of all anchors in every step.
            "log_scales": DenseTable(model.log_scales),
        }
        self._seen_layout = replace(model.layout, num_periods=1)

    def seen(self, visible: Tensor, row: int) -> AnchorModel:
        """Return the visible anchors with one of the features that vary: a model of one period."""
        model = self.model
        if model.layout.period_dim:
            blocks = model.block_rows[:, row].index_select(0, visible)
            rows = own_blocks(len(visible), 1).to(blocks)
        else:
            rows = model.block_rows[visible]
            blocks = rows.flatten()
        wanted = dict.fromkeys(PER_ANCHOR, visible) | {"blocks": blocks}
        fetched = self._fetch(wanted)
        return type(model)(
            self._seen_layout,
            anchors=model.anchors.index_select(0, visible),
            **fetched,
            block_rows=rows,
            global_features=model.global_features[row : row + 1],
            heads=model.heads,
            used_offsets=None if model.used_offsets is None else model.used_offsets[visible],
        )

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

    def gradients(self) -> dict[str, Tensor]:
        """Return all gradients that there are, by the names of their tensors."""
        found = {name: table.gradient() for name, table in self.tables.items()}
        return self.adam.gradients() | {n: grad for n, grad in found.items() if grad is not None}

    def step(self, rates: Mapping[str, float], *, resized: bool) -> None:
        """Do one step of Adam.

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
            rows = len(model.blocks) + own_blocks(*blocks.shape[:2]).to(model.device)
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
