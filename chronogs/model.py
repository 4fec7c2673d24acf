"""Model of ChronoGS: anchors with features that vary with the period, and their fusion.

With e(t) the period weights (one-hot for a whole period t, see `periods`), an anchor i has at t

    v_i(t) = sum_s e_s(t) v_is        its varying feature, a mixture of one block per period,
    g(t)   = sum_s e_s(t) g_s         the global feature of the period, equal for all anchors,

beside the base feature b_i, which all periods share. Opacity, covariance and colour MLP see

    concat:  (b_i, v_i(t), d_i, g(t))       official code,
    sum:     (b_i + v_i(t) + g(t), d_i)     formula of the paper; needs equal lengths,

where d_i is the viewing direction. Positions and offsets are shared by all periods: geometry
changes by Gaussians that are switched on and off, opacity = tanh(MLP) <= 0 being off.

Source: ChronoGS (arXiv 2511.18794), section 3, and the official code. The mixtures are computed in
`chronoscene.anchors.decode`, whose inputs are those of ``concat``.
"""

from __future__ import annotations

from torch import Tensor

from chronogs.config import ChronoGSConfig
from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.model import AnchorLayout, AnchorModel, zero_columns


class ChronoGSModel(AnchorModel):
    """Anchors with a base feature, one feature per period, and one global feature per period."""

    @classmethod
    def global_start(cls, config: AnchorConfig) -> str:
        assert isinstance(config, ChronoGSConfig)
        return config.global_init

    @staticmethod
    def input_dim(layout: AnchorLayout, head: str) -> int:
        if layout.fusion == "concat":
            return AnchorModel.input_dim(layout, head)
        return max(layout.base_dim, layout.period_dim, layout.global_dim) + 3

    def first_layer(self, head: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        layout, w1 = self.layout, self.heads[head].w1
        if layout.fusion == "concat":
            return super().first_layer(head)
        # w (b + v + g) = w b + w v + w g: features that are added share their columns.
        dims = (layout.base_dim, layout.period_dim, layout.global_dim)
        base, period, table = (w1[:, : max(dims) if n else 0] for n in dims)
        if head not in layout.global_heads:
            table = zero_columns(w1, layout.global_dim)
        return base, period, w1[:, max(dims) :], table
