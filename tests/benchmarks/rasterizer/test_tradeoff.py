"""Variants of the package are made by patches, which must fit the package as it is."""

import pytest

from benchmarks.rasterizer.tradeoff import EXACT, VARIANTS, Variant, patched_files


@pytest.mark.parametrize("variant", (EXACT, *VARIANTS), ids=lambda variant: variant.name)
def test_the_patches_of_every_variant_fit(variant):
    files = patched_files(variant)
    assert all(new in files[name] for name, _, new in variant.patches)


def test_a_patch_that_does_not_fit_is_named():
    patch = ("rasterizer/constants.py", "ALPHA_MIN = 3", "ALPHA_MIN = 4")
    with pytest.raises(SystemExit, match=r"^odd: rasterizer/constants\.py: expected once"):
        patched_files(Variant("odd", (patch,)))
