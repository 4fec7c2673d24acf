"""Faults that checks of methods must find. That our methods have none: tests/methods."""

import pytest

from chronoscene.gaussians.method import GaussianMethod
from chronoscene.harness import contract
from chronoscene.harness.contract import CHECKS, check_method
from chronoscene.harness.train.checks import MethodError
from chronoscene.kernels.runtime import available_threads


@pytest.fixture
def problems(monkeypatch, tmp_path):
    """What some checks say of a toy method, by the name of the check."""

    def check(name, *checks):
        chosen = [c for c in CHECKS if c.__name__ in checks]
        assert len(chosen) == len(checks)
        findings = check_method(f"toy_methods:{name}", chosen)
        return [finding.problem for finding in findings]

    return check


def test_faults_name_the_field(problems):
    rules = ("presets_build_a_frozen_config", "a_model_is_two_files", "size_counts_what_is_stored")
    presets, model, size = problems("MEAN", *rules)
    assert presets.startswith(
        "MethodSpec.presets: expected a preset fast, found ['balanced', 'slow']"
    )
    assert model.startswith("save: expected the files model.safetensors and model.json, found ['")
    assert "model.safetensors" in size
    (loaded,) = problems("MEAN", "declared_outputs_are_there")
    assert loaded is None
    (image,) = problems("BAD_IMAGE", "declared_outputs_are_there")
    assert image.startswith("render: Prediction.rgb: expected a finite float32 array of shape [30,")


def test_a_method_that_looks_at_test_photos_is_found(problems, monkeypatch, tmp_path):
    rule = "test_photos_change_nothing"
    monkeypatch.setattr(contract, "TemporaryDirectory", lambda: _Folder(tmp_path))
    monkeypatch.setenv("TOY_PEEK", str(tmp_path))
    assert problems("PEEKING", rule) == [
        "training: expected a model that does not depend on test photos, found a difference in "
        "model.json; correct the method, or report it to its author; see "
        "docs/guides/adding-a-method.md"
    ]
    monkeypatch.delenv("TOY_PEEK")
    assert problems("PEEKING", rule) == [None]


def test_a_loss_that_threads_round_is_found(problems):
    threads = [c for c in CHECKS if c.__name__.startswith("threads_change_nothing")]
    if available_threads() < 2:
        pytest.skip("needs two processors")
    few, many = problems("TORCH_MEANS", *(c.__name__ for c in threads))
    assert few is None
    assert many.startswith("training with 60,000 points and 2 threads instead of 1: expected")
    assert problems("MEAN", "threads_change_nothing_for_many_points") == [None]


def test_gaussians_of_another_period_are_found(problems):
    (problem,) = problems("LOSES_COLOURS", "gaussians_look_like_the_model")
    assert problem.startswith(
        "to_gaussians of periods 0 and 1: expected what changes in render, found 100% of"
    )
    assert problems("MEAN", "gaussians_look_like_the_model") == [None]


def test_a_part_of_the_model_that_keeps_its_order_is_found(monkeypatch):
    def permute(self, order):
        parameters = self.model.parameters
        self.model.parameters = {**parameters, "means": parameters["means"][order.tolist()]}

    chosen = [check for check in CHECKS if check.__name__ == "another_order_shows_the_same"]
    assert [result.problem for result in check_method("3dgs", chosen)] == [None]
    monkeypatch.setattr(GaussianMethod, "permute", permute)
    (result,) = check_method("3dgs", chosen)
    assert result.problem.startswith("permute, period 0: expected nearly equal pixels, found ")


class _Folder:
    def __init__(self, path):
        self.path = path

    def __enter__(self):
        return str(self.path)

    def __exit__(self, *error):
        pass


def test_every_check_has_a_rule_in_a_sentence():
    for check in CHECKS:
        assert check.__doc__.split("\n\n")[0].rstrip().endswith("."), check.__name__


def test_a_failing_method_fails_check_by_check(problems):
    crash, spec = problems("RAISES", "training_lowers_the_loss", "spec_is_plain_data")
    # In the order of the checks.
    assert crash is None and spec == "RuntimeError: the toy is broken"


def test_other_programs_are_refused():
    with pytest.raises(MethodError, match="expected a method with a class, found another program"):
        next(check_method("baselines.external:SPLATFACTO"))
