"""Budgets are parsed, progress never leaves 0..1, shares add up."""

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.errors import ConfigError
from chronoscene.harness.files.command_line import command_line
from chronoscene.harness.files.source import RunOrigin
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.resolve import resolve, resolve_method
from chronoscene.harness.plan.settings import RunSettings
from chronoscene.harness.plan.stop import StopRule, duration_text, parse_duration
from chronoscene.methods import load_spec

JOB = Job(
    origin=RunOrigin(method="toy_methods:MEAN", scene_root="/scene", scene_format="chronoscene"),
    scene="scene", scene_hash="1", split_hash="2",
    method_name="mean", strategy="separate", seed=0, commit="3",
    settings=RunSettings(Path("/runs"), iterations=9, device="cpu"),
)  # fmt: skip


COPY = JOB.origin.model_copy(update={"scene_root": "/copy"})


def changed(change: dict[str, Any]) -> Job:
    """The job with other values of its own or of its settings."""
    own = {name: value for name, value in change.items() if name in Job.__slots__}
    others = {name: value for name, value in change.items() if name not in own}
    return replace(JOB, **own).with_settings(**others)


def test_a_share_at_half_size_counts_where_a_photo_is_large():
    origin = JOB.origin.model_copy(update={"method": "chronogs"})

    def document(share, pixels):
        options = {"preset": "fast", "overrides": {"half_size_share": share}}
        return resolve(changed({"origin": origin, "photo_pixels": pixels, **options})).document

    without, halved = ([document(s, n) for n in (399_999, 400_000)] for s in ("0", "0.5"))
    assert len({found["config_hash"] for found in (*without, halved[0])}) == 1
    assert halved[1]["config_hash"] != without[1]["config_hash"]
    assert halved[1]["config"]["method_config"]["half_size_share"] == 0.5


@pytest.mark.parametrize("character", ["a", "日", "\U0001f327", "/", '"'])
def test_folders_of_runs_have_names_that_file_systems_allow(character):
    names = [changed({"variant": f"s={character * n}"}).folder.parent.name for n in (9, 150, 999)]
    assert len({*names}) == 3 and all(len(name.encode()) <= 255 for name in names)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90), ("5m", 300), ("1.5h", 5400), ("1h30m", 5400), ("2m3.5s", 123.5)],
)
def test_durations(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((90, "90s"), (1.5, "1.5s"), (999_999, "999999s"), (123_456.7, "123457s")),
        *((1_000_000, "1000000s"), (1_234_567.5, "1234567.5s"), (1e22, f"1{'0' * 22}s")),
        (0.00001, "0.00001s"),
    ],
)
def test_durations_are_read_as_they_are_written(seconds, text):
    assert duration_text(seconds) == text
    assert parse_duration(text) == pytest.approx(seconds, rel=1e-5)


@pytest.mark.parametrize("text", ["", "5", "m", "0s", "-5m", "5 m", "5min", "1e3s", "5m!"])
def test_other_texts_are_refused(text):
    with pytest.raises(ConfigError, match="--budget: expected a positive time such as 90s"):
        parse_duration(text)


@given(
    st.one_of(st.none(), st.integers(1, 10**6)),
    st.one_of(st.none(), st.floats(0.01, 1e5)),
    st.integers(0, 10**7),
    st.floats(0, 1e6),
)
def test_progress_is_a_share(iterations, budget, done, seconds):
    rule = StopRule(iterations, budget)
    progress = rule.progress(done, seconds)
    assert 0 <= progress <= 1
    assert rule.progress(done + 1, seconds + 1) >= progress


def test_progress_by_hand():
    assert StopRule(200, None).progress(50, 1e9) == 0.25
    assert StopRule(None, 10.0).progress(10**9, 2.5) == 0.25
    assert StopRule(200, 10.0).progress(50, 9.0) == 0.9
    assert StopRule(200, 10.0).progress(190, 1.0) == 0.95
    assert StopRule(200, None).progress(200, 0.0) == 1.0


@given(st.integers(1, 10**5), st.integers(1, 60))
def test_shares_add_up(iterations, parts):
    shares = [rule.iterations for rule in StopRule(iterations, None).split(parts)]
    assert sum(shares) == iterations
    assert max(shares) - min(shares) <= 1


def test_budgets_are_shared_or_repeated():
    assert StopRule(7, 9.0).times(3) == StopRule(21, 27.0)
    assert StopRule(None, 9.0).times(2) == StopRule(None, 18.0)
    assert StopRule(None, 9.0).split(3) == (StopRule(None, 3.0),) * 3
    assert StopRule(7, 9.0).split(3) == (StopRule(3, 3.0), StopRule(2, 3.0), StopRule(2, 3.0))


def test_time_left_follows_the_pace():
    assert StopRule(100, None).seconds_left(25, 5.0) == pytest.approx(15.0)
    assert StopRule(None, 60.0).seconds_left(3, 20.0) == pytest.approx(40.0)
    assert StopRule(100, None).seconds_left(0, 0.0) is None


@pytest.mark.parametrize(
    "change",
    [
        {"scene_hash": "4"}, {"strategy": "joint"}, {"overrides": {"rate": "0.25"}}, {"seed": 1},
        {"iterations": 10}, {"budget_seconds": 60.0}, {"separate_iterations": "each"},
        {"max_width": 800}, {"device": "auto"},
    ],
    ids=str,
)  # fmt: skip
def test_what_decides_the_result_is_compared(change):
    assert resolve(changed(change)).document != resolve(JOB).document


def test_where_and_how_fast_it_runs_is_not_compared():
    other = changed({"runs": Path("/other"), "threads": 3, "commit": "5", "origin": COPY})
    assert resolve(other).document == resolve(JOB).document


def test_a_job_goes_through_json_unchanged():
    job = changed({"lpips_weights": Path("/weights"), "overrides": {"rate": "1"}, "memory": 7})
    assert Job.from_document(json.loads(json.dumps(job.document()))) == job


def test_folders_have_names_that_file_systems_take():
    one, other = (replace(JOB, variant=f"a={'9' * 300}{i}").folder.parent.name for i in (1, 2))
    assert len(one) < 200 and one[:180] == other[:180] and one != other
    assert replace(JOB, variant="path=/a").folder.parent.name.endswith("-path=%2Fa")


@pytest.mark.parametrize(
    ("changes", "variant"),
    [
        ({"iterations": 20}, ""),
        ({"iterations": 9, "overrides": {"rate": "0.25", "sleep": "0"}}, "iterations=9,rate=0.25"),
        ({"iterations": None, "budget_seconds": 90.0}, "budget=90s"),
        ({"iterations": 20, "budget_seconds": 1.5}, "iterations=20,budget=1.5s"),
        ({"iterations": None, "budget_seconds": 1e6}, "budget=1000000s"),
        ({"iterations": 9, "continued_from": [3, 5]}, "iterations=3+5+9"),
        ({"iterations": 20, "separate_iterations": "each"}, "separate_iterations=each"),
    ],
    ids=str,
)
def test_variants_are_named_by_what_differs_from_the_preset(changes, variant):
    job = changed(changes)
    method = resolve_method(job.origin.method, load_spec(job.origin.method), job.settings)
    assert method.run(job).job.variant == variant


def test_a_budget_of_each_model_is_named_though_the_preset_has_it():
    settings = replace(JOB.settings, overrides={}, iterations=None, budget_seconds=90.0)
    job = replace(JOB, strategy="separate", settings=settings)
    method = resolve_method("toy_methods:DATED", load_spec("toy_methods:DATED"), settings)
    assert method.run(job).job.variant == "budget=90s,separate_iterations=each"


def test_the_command_names_what_differs_from_the_preset():
    variant = 'iterations=50,heads=["a", "b"],budget=90s,separate_iterations=each,max_width=800'
    config = {"method": "m", "strategy": "joint", "preset": "fast", "variant": variant}
    assert shlex.split(command_line("DIR", config))[9:] == [
        *("--iterations", "50", "--set", 'heads=["a", "b"]', "--budget", "90s"),
        *("--separate-iterations", "each", "--max-width", "800"),
    ]
    config["variant"] = "iterations=20+50"
    assert command_line("DIR", config).endswith(" --continue-to 50")
    config["variant"] = "validation=true,validation_seed=2,fit_half=true"
    assert command_line("DIR", config).endswith(" fast --validation --validation-seed 2 --fit-half")
    config["variant"] = "sh_degree=2,budget=90s"
    assert command_line("DIR", config, 0).endswith("--seed 0 --set sh_degree=2 --budget 90s")


@pytest.mark.parametrize(("method", "name"), [("3dgs", "3dgs"), ("not-installed", "module:SPEC")])
def test_the_command_has_no_name_that_bench_does_not_know(method, name):
    config = {"method": method, "strategy": "joint", "preset": "fast", "variant": ""}
    assert f" --method {name} " in command_line("DIR", config)


def test_the_command_names_the_file_of_a_preset_that_the_method_lacks():
    for method, preset in (("3dgs", "mine.toml"), ("3dgs", "fast"), ("not-installed", "mine")):
        name = preset.removesuffix(".toml")
        config = {"method": method, "strategy": "joint", "preset": name, "variant": ""}
        assert command_line("DIR", config).endswith(f"--preset {preset}")


@pytest.mark.parametrize(
    ("label", "option"),
    [("0.1dB", "--max-loss 0.1"), ("1e-05dB", "--max-loss 1e-05"), ("plain", "--plain")],
)
def test_two_commands_make_a_compressed_run(label, option):
    variant = f"sh_degree=2,compressed={label},max_width=800"
    config = {"method": "m", "strategy": "joint", "preset": "fast", "variant": variant}
    train, compress = command_line("DIR", config).split(" && ")
    assert train.endswith("--preset fast --set sh_degree=2 --max-width 800")
    assert compress == f"chronoscene compress RUN {option}"
