"""One table of names, each with its variant; unknown names are refused."""

import numpy as np
import pytest
from installed import install

from chronoscene.errors import ConfigError
from chronoscene.metrics.registry import METRICS, all_metrics, make_scorers, metric_info

PLUG_IN = """
from chronoscene.metrics.registry import MetricInfo

def mae(image, reference, mask):
    return abs(image.astype(float) - reference)[... if mask is None else mask].mean() / 255

MAE = MetricInfo("mae", "MAE", "mean absolute error", False, 4, mae)
"""


def test_names_carry_their_variant():
    usual = ["psnr", "ssim", "ssim_valid", "lpips_vgg", "lpips_vgg_3dgs"]
    assert list(METRICS) == [*usual, "psnr_cc", "ssim_cc", "flip"]
    assert all(info.name == name and info.variant for name, info in METRICS.items())
    assert not metric_info("lpips_vgg").higher_is_better


def test_some_are_computed_only_where_they_are_named():
    usual, one = make_scorers(), make_scorers(["psnr_cc"])
    on_request = {"psnr_cc", "ssim_cc", "flip"}
    assert usual.unasked == on_request and not on_request & {*usual.functions, *usual.skipped}
    assert list(one.functions) == ["psnr_cc"] and one.unasked == {*METRICS} - {"psnr_cc"}


def test_unknown_metrics_name_the_known_ones():
    with pytest.raises(ConfigError, match="did you mean 'lpips_vgg'"):
        make_scorers(["lpips"])


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    """Install metrics by their entry points."""

    def add(entries):
        install(monkeypatch, tmp_path, {"mae_metric": PLUG_IN}, "chronoscene.metrics", entries)
        all_metrics.cache_clear()

    yield add
    monkeypatch.undo()
    all_metrics.cache_clear()


def test_metrics_of_other_packages_are_computed(plug_in):
    plug_in({"mae": "mae_metric:MAE"})
    assert [*all_metrics()] == [*METRICS, "mae"] and metric_info("mae").title == "MAE"
    black, grey = np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 51, np.uint8)
    scorers = make_scorers()
    assert scorers.functions["mae"](black, grey, None) == 0.2
    assert set(scorers.functions) >= {"psnr", "ssim", "mae"}


def test_a_metric_under_another_name_is_refused(plug_in):
    plug_in({"l1": "mae_metric:MAE"})
    with pytest.raises(
        ConfigError, match=r"chronoscene\.metrics: l1: expected a MetricInfo of the"
    ):
        all_metrics()


def test_a_metric_that_cannot_be_imported_is_named(plug_in):
    plug_in({"gone": "mae_metric:GONE"})
    with pytest.raises(ConfigError, match=r"^metric gone: .* package plug-in names, found Attrib"):
        all_metrics()
