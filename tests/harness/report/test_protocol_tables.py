"""Runs under a protocol: printed rows beside them, and a comparison of their own."""

import json

from made_runs import record

from chronoscene.harness.report.comparable import apart, comparable
from chronoscene.harness.report.published import load_published
from chronoscene.harness.report.tables import format_runs


def wat(scene, psnr, ssim=0.75, **changes):
    fields = {"protocol": "wat", "variant": "protocol=wat", "scene_hash": scene, **changes}
    scores = {"psnr": (psnr - 1, psnr + 1), "ssim": ssim and (ssim, ssim)}
    return record("clnerf", scene=scene, **scores, **fields)


def test_printed_rows_stand_below_the_measured_mean():
    runs = [wat("spa", 20.0), wat("spa", 21.0, seed=1), wat("grill", 25.5)]
    text = format_runs(runs, [], "json", published=load_published())
    rows = json.loads(text)["protocols"]
    assert rows[0] == {
        "protocol": "wat",
        "method": "CLNERF (joint, fast, protocol=wat)",
        "source": "measured",
        "scenes": 2,
        "values": {"psnr": 23.0, "ssim": 0.75},
    }
    assert [row["method"] for row in rows[1:]] == [
        f"{name} (published)" for name in ("NeRF", "MEIL-NeRF", "CLNeRF", "ChronoGS")
    ]
    assert rows[3]["values"] == {"psnr": 25.45, "ssim": 0.764}
    table = format_runs(runs, [], "markdown", published=load_published())
    assert table.startswith("**WAT (--protocol wat): means over all test views of a scene")
    assert "| CLNeRF (published) | 25.45 | 0.7640 | - |" in table
    assert "nothing is published of" not in table


def test_a_scene_with_two_names_counts_once():
    runs = [wat("spa", 20.0), wat("bath", 21.0, scene_hash="spa"), wat("grill", 25.5)]
    text = format_runs(apart(runs), [], "json", published=load_published())
    row = json.loads(text)["protocols"][0]
    assert row["scenes"] == 2 and row["values"]["psnr"] == 23.0


def test_one_seed_of_two_commits_is_two_rows():
    runs = [wat("spa", 20.0), wat("spa", 26.0, commit="def"), wat("spa", 21.0, seed=1)]
    rows = json.loads(format_runs(runs, [], "json", published=load_published()))["protocols"]
    found = {row["method"]: row["values"]["psnr"] for row in rows[:2]}
    name = "CLNERF (joint, fast, protocol=wat)"
    assert found == {f"{name} [code abc]": 20.5, f"{name} [code def]": 26.0}


def test_methods_are_renamed_here_too():
    options = {"published": load_published(), "renames": {"CLNERF (joint, ": "Ours ("}}
    table = format_runs([wat("spa", 20.0)], [], "markdown", **options)
    first, *others = table.split("\n\n**")
    assert "Ours (fast, protocol=wat)" in first and "CLNERF" not in first
    assert all("Ours (fast, protocol=wat)" in other for other in others)


def test_a_metric_that_was_not_computed_is_a_dash():
    run = wat("spa", 20.0, ssim=None)
    table = format_runs([run], [], "markdown", published=load_published())
    assert "| 20.00 | - | 1 |" in table


def test_without_a_protocol_nothing_is_added():
    text = format_runs([record()], [], "json", published=load_published())
    assert "protocols" not in json.loads(text)


def test_runs_under_a_protocol_are_compared_with_each_other_alone():
    runs = [wat("spa", 20.0), wat("spa", 21.0, seed=1)]
    runs.append(record("clnerf", scene="spa", scene_hash="spa"))
    assert sorted(len(group) for group in comparable(runs).values()) == [1, 2]
    names = [run.scene for run in apart(runs)]
    assert names == ["spa [protocol wat]", "spa [protocol wat]", "spa [protocol none]"]
    assert any("different --protocol (wat, none)" in text for text in apart(runs)[0].notices)
