"""The published table is complete and gives the means that its rows imply."""

import pandas as pd
import pytest

from chronoscene.harness.report.published import load_published
from chronoscene.methods import method_names


def test_every_method_has_every_scene():
    table = load_published()
    scenes = {row.scene for row in table.rows}
    methods = {row.method for row in table.rows}
    assert len(scenes) == 12
    assert len(table.rows) == len(scenes) * len(methods)


def test_means_by_group():
    # Unweighted means worked out by hand from the printed rows.
    rows = pd.DataFrame([row.model_dump() for row in load_published().rows])
    means = rows.groupby(["method", "group"]).psnr.mean()
    assert means["ChronoGS", "real"] == pytest.approx(23.465, abs=5e-4)
    assert means["ChronoGS", "synthetic"] == pytest.approx(27.4617, abs=5e-4)
    assert rows[rows.method == "Scaffold-GS"].psnr.mean() == pytest.approx(17.1775, abs=5e-4)


def test_all_tables_of_the_paper_are_there():
    table = load_published()
    ids = ("counts", "per_period_training", "ablation_components", "ablation_d_g", "ablation_d_v")
    ids += ("ablation_d_b", "ablation_init", "wat", "cl_splats_real", "five_pointz")
    assert [further.id for further in table.tables] == [*ids, "hyperparameters"]
    assert len(table.inconsistencies) == 18
    counts = table.tables[0]
    scenes = [row for row in counts.rows if row[2] == "all" and row[0] != "all"]
    # The printed totals are in the last row.
    assert [sum(row[i] for row in scenes) for i in (3, 4)] == [*counts.rows[-1][3:]]


def test_methods_have_ids_of_their_own():
    table = load_published()
    assert {row.method for row in table.rows} <= table.methods.keys()
    assert len({*table.methods.values()}) == len(table.methods) == 17


def test_no_row_of_the_main_table_is_without_a_method():
    table = load_published()
    assert {table.methods[row.method] for row in table.rows} <= {*method_names()}


def test_rows_of_other_datasets_without_a_method_are_known():
    table = load_published()
    rows = {
        str(row[0]) for t in table.tables if t.id in ("wat", "cl_splats_real", "five_pointz")
        for row in t.rows
    }  # fmt: skip
    missing = {name for name in rows if table.methods[name] not in method_names()}
    assert missing == {"GsEditor"}  # it edits by text, and has no notion of periods
