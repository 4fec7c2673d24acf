"""What every installed method must do, so that the harness need not know which one it drives.

The rules are those of ``chronoscene check-method``; ``pytest tests/methods -k NAME`` checks one.
"""

import json

import numpy as np
import pytest

from chronoscene.harness.contract import CHECKS
from chronoscene.harness.contract.subject import PAUSE, NotApplicableError, Subject, train_elsewhere
from chronoscene.harness.contract.tiny_training import STEPS
from chronoscene.harness.contract.training import (
    equal_seeds_give_equal_bytes,
    threads_change_nothing_for_many_points,
)
from chronoscene.methods import load_spec, method_names
from chronoscene.training import photometric

SLOW = {n for n in method_names() if load_spec(n).mixes_views} | {"3dgs-period", "scaffold-gs"}
"""Radiance fields take long; ``tests/fields`` has what is quick of the rules. The other two have
the code of ``3dgs`` and ``scaffold-gs-period``."""
QUICK = [name for name in method_names() if name not in SLOW]

SLOW_RULES = {threads_change_nothing_for_many_points}


@pytest.fixture(scope="module")
def elsewhere(made_once):
    """All quick methods in one process, most of whose time it takes to start."""
    return made_once("elsewhere", lambda folder: train_elsewhere(QUICK, folder))


@pytest.fixture(
    scope="module",
    params=[n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in method_names()],
)
def subject(request, tmp_path_factory):
    return Subject(request.param, tmp_path_factory.mktemp(request.param))


@pytest.mark.parametrize(
    "check",
    [pytest.param(c, marks=pytest.mark.slow) if c in SLOW_RULES else c for c in CHECKS],
    ids=[check.__name__ for check in CHECKS],
)
def test_the_contract(subject, check, request):
    if check is equal_seeds_give_equal_bytes and subject.name in QUICK:
        subject.elsewhere = request.getfixturevalue("elsewhere")
    try:
        check(subject)
    except NotApplicableError as reason:
        pytest.skip(str(reason))


def test_saving_a_training_and_a_step_that_is_not_finite_change_nothing(
    subject, tmp_path, monkeypatch
):
    """The step counts as a drawn view, and nothing else of the training is different."""
    if not subject.spec.resumable:
        pytest.skip("the method cannot be resumed")
    if subject.spec.mixes_views:
        pytest.skip("its steps have no photo and no loss of photos")
    method = subject.resumed(subject.interrupted)
    compute = photometric._loss_and_gradient

    def poisoned(*args):
        loss, gradient = compute(*args)
        return loss, gradient * np.inf

    with monkeypatch.context() as patch:
        patch.setattr(photometric, "_loss_and_gradient", poisoned)
        assert method.step(PAUSE, PAUSE / STEPS).skipped == "not finite"
    method.trainer.sampler.drawn -= 1
    method.save_training(tmp_path)
    before = json.loads((subject.interrupted / "training.json").read_text())
    after = json.loads((tmp_path / "training.json").read_text())
    assert after["tensors_sha256"] == before["tensors_sha256"]
    assert method.step(PAUSE, PAUSE / STEPS) == subject.reports[PAUSE]
