"""Differences are paired by seed."""

from benchmarks.methods.released_values import table_rows
from tests.made_runs import record


def test_differences_are_to_the_first_row_with_the_same_seed():
    def of(seed, psnr):
        return record(
            seed=seed, psnr=(psnr, psnr), ssim=(0.5, 0.7), primitives=1_000 + 1_000 * seed
        )

    first = [of(0, 20.0), of(1, 22.0), of(2, 24.0)]
    rows = table_rows({"as it is": first, "other": [of(2, 23.5), of(0, 19.0)], "failed": []})
    assert rows == [
        ["as it is", "22.00 ± 2.00", "0.00 ± 0.00", "0.600 ± 0.000", "2,000", "3"],
        ["other", "21.25 ± 3.18", "-0.75 ± 0.35", "0.600 ± 0.000", "2,000", "2"],
        ["failed", "-", "-", "-", "-", "0"],
    ]
