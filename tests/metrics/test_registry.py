"""One table of names, each with its variant; unknown names are refused."""

import pytest

from chronoscene.errors import ConfigError
from chronoscene.metrics.registry import METRICS, make_scorers, metric_info


def test_names_carry_their_variant():
    assert list(METRICS) == ["psnr", "ssim", "ssim_valid", "lpips_vgg", "lpips_vgg_3dgs"]
    assert all(info.name == name and info.variant for name, info in METRICS.items())
    assert not metric_info("lpips_vgg").higher_is_better


def test_unknown_metrics_name_the_known_ones():
    with pytest.raises(ConfigError, match="did you mean 'lpips_vgg'"):
        make_scorers(["lpips"])
