"""Trainings that are compared up to rounding."""

import pytest

from chronoscene.training.optimizers import adam, row_adam


def raise_eps(monkeypatch: pytest.MonkeyPatch, eps: float) -> None:
    """Give Adam an epsilon far above gradients that are rounding.

    A gradient that is zero but for rounding, such as that of the rotation of a sphere, otherwise
    makes a whole step, in a direction that the processor decides.
    """
    for module in (adam, row_adam):
        monkeypatch.setattr(module, "EPS", eps)
