"""The published table is complete and gives the means that its rows imply."""

import pytest

from leaderboard.published import load_published


def test_every_method_has_every_scene():
    table = load_published()
    scenes = {row.scene for row in table.rows}
    methods = {row.method for row in table.rows}
    assert len(scenes) == 12
    assert len(table.rows) == len(scenes) * len(methods)


def test_means_by_group():
    table = load_published()
    # Unweighted means worked out by hand from the printed rows.
    assert table.mean("ChronoGS", "psnr", group="real") == pytest.approx(23.465, abs=5e-4)
    assert table.mean("ChronoGS", "psnr", group="synthetic") == pytest.approx(27.4617, abs=5e-4)
    assert table.mean("Scaffold-GS", "psnr") == pytest.approx(17.1775, abs=5e-4)


def test_unknown_method_is_an_error():
    with pytest.raises(KeyError, match="nerf"):
        load_published().mean("nerf", "psnr")
