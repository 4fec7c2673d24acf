"""The table of a study: differences to its first row, published figures, and directions."""

import json
import math

import numpy as np
import pytest

from chronoscene.harness.files.records import write_run
from chronoscene.harness.study.plan import Study
from chronoscene.harness.study.tables import (
    direction,
    directions,
    study_entries,
    study_table,
    study_texts,
)
from tests.made_runs import scored

STUDY = Study.model_validate(
    {
        "title": "Parts of a method",
        "question": "What does it lose without a part?",
        "method": "chronogs",
        "source": "A paper, table 3",
        "notes": ["parts are left out one by one"],
        "rows": [
            {"label": "full", "published": {"Square": {"psnr": 25.0, "checkpoint_bytes": 1e6}}},
            {"label": "without a", "published": {"Square": {"psnr": 24.5}}},
            {"label": "without b", "published": {"Square": {"psnr": 25.25}}},
            {"label": "without c", "published": {"Square": {"psnr": 24.0}}},
            {"label": "twice d"},
        ],
    }
)


def made(shift, seed, spread=0.0):
    """Twelve views in each of two periods that are better by about ``shift`` than in any other."""
    rng = np.random.default_rng(1)
    views, noise = rng.standard_normal((2, 2, 12))
    return scored(
        seed=seed,
        psnr=20 + views + shift + spread * (noise - noise.mean()),
        variant=f"shift={shift}",
        config_hash=f"shift {shift}",
    )


@pytest.fixture
def runs():
    """Clearly worse without a and b, not clearly without c."""
    shifts = {"full": (0, 0), "without a": (-1, 0.1), "without b": (-1, 0.1), "twice d": (1, 0.1)}
    found = {k: [made(s, i, n) for i in range(2)] for k, (s, n) in shifts.items()}
    return found | {"without c": [made(0.01, i, 1.0) for i in range(2)]}


def test_directions(runs):
    assert directions(STUDY, study_entries(STUDY, runs)) == [
        "plaza, without a: in PSNR [dB] the direction agrees with the published one.",
        "plaza, without b: in PSNR [dB] the direction disagrees with the published one.",
        "plaza, without c: in PSNR [dB] the direction cannot be determined "
        "(the interval contains 0).",
        "plaza, twice d: nothing is published to compare with.",
    ]


def test_a_row_without_a_result_has_no_direction(runs):
    entries = study_entries(STUDY, runs | {"without a": []})
    _, row, *_ = study_table(STUDY, entries).rows
    assert row == ["plaza", "without a", "-", "-", "24.50 (\N{MINUS SIGN}0.50)", "-", "-", "-"]
    without = directions(STUDY, entries)
    assert (
        without[0]
        == "plaza, without a: in PSNR [dB] the direction cannot be determined (no result)."
    )
    first = directions(STUDY, study_entries(STUDY, runs | {"full": []}))
    assert "cannot be determined (there is no interval)" in first[0]


@pytest.mark.parametrize(
    ("low", "high", "by_seeds", "published", "expected"),
    [
        (-0.2, -0.1, math.nan, (-1.0, -0.1), "agrees with the published one"),
        (0.1, 0.2, 0.1, (1.0,), "agrees with the published one"),
        (0.1, 0.2, 0.1, (-1.0,), "disagrees with the published one"),
        (-0.1, 0.2, 0.01, (-1.0,), "cannot be determined (the interval contains 0)"),
        (
            *(-0.1, 0.2, 0.0621, (-1.0,)),
            "cannot be determined (seeds alone explain differences up to 0.06)",
        ),
        (math.nan, math.nan, 0.0, (-1.0,), "cannot be determined (there is no interval)"),
        (0.1, 0.2, 0.0, (-1.0, 1.0), "cannot be determined (the published scenes do not agree)"),
        (0.1, 0.2, 0.0, (0.0,), "cannot be determined (the published scenes do not agree)"),
    ],
)
def test_direction_of_a_difference(low, high, by_seeds, published, expected):
    entry = {"difference_low": low, "difference_high": high, "by_seeds": by_seeds}
    entry |= {"difference": (low + high) / 2, "quantity": "psnr"}
    assert direction(entry, published) == expected


def test_two_seeds_that_differ_by_a_fifth_of_the_effect_decide():
    rows = {"full": (0, 0.2), "without a": (-1, -1.2)}
    runs = {label: [made(s, i) for i, s in enumerate(row)] for label, row in rows.items()}
    for run in (run for of_row in runs.values() for run in of_row):
        run.config_hash = f"seeds of {run.variant[:7]}"
    runs |= {label: [] for label in ("without b", "without c", "twice d")}
    study = STUDY.model_copy(update={"rows": STUDY.rows[:2]})
    assert directions(study, study_entries(study, runs)) == [
        "plaza, without a: in PSNR [dB] the direction agrees with the published one."
    ]


def test_every_format_has_measured_and_published_figures(runs, tmp_path):
    finished = {}
    for label, records in runs.items():
        finished[label] = [tmp_path / f"{label} {run.seed}" for run in records]
        for folder, run in zip(finished[label], records, strict=True):
            folder.mkdir()
            write_run(folder, run, run.rows)
    texts = study_texts(STUDY.model_copy(update={"notes": (*STUDY.notes, "<b>")}), finished, [])
    assert "\n- \\<b\\>\n" in texts["markdown"] and "\n<b>\n" in texts["table"]
    lines = texts["markdown"].splitlines()
    assert lines[0] == "What does it lose without a part?"
    head, full, a = (line for line in lines if line.startswith(("| scene", "| plaza | full")) or
                     "| without a |" in line)  # fmt: skip
    assert "PSNR [dB] measured | PSNR [dB] difference" in head
    assert "| PSNR [dB] Square (published) | checkpoint [MB] measured |" in head
    assert "± 0.00 | - | 25.00 | 1.234 ± 0.000 | 1.000 | 0 1 |" in full
    assert "| 24.50 (\N{MINUS SIGN}0.50) |" in a
    for text in (texts["markdown"], texts["table"]):
        assert "published: A paper, table 3" in text and "parts are left out one by one" in text
        assert "plaza, without a: in PSNR [dB] the direction agrees" in text.replace("\\", "")
        assert "macro: mean over periods\n" in text  # and nothing of what only `table` shows
        assert "95 % interval of macro" not in text

    entries = json.loads(texts["json"])["entries"]
    by_key = {(e["source"], e["row"], e["quantity"]): e for e in entries}
    measured = by_key["measured", "without a", "psnr"]
    gaps = np.subtract(
        *([row.value for row in runs[label][0].rows] for label in ("without a", "full"))
    )
    assert measured["difference"] == pytest.approx(gaps.mean())
    assert measured["difference_low"] < measured["difference"] < measured["difference_high"] < 0
    assert measured["n"] == 2 and measured["seeds"] == "0 1"
    published = by_key["A paper, table 3", "without a", "psnr"]
    assert published["scene"] == "Square" and published["difference"] == -0.5
    header, *rows = texts["csv"].splitlines()
    assert header.split(",")[:3] == ["row", "source", "scene"] and len(rows) == len(entries)
