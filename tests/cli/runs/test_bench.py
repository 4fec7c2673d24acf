"""``chronoscene bench`` from the outside: options, output, exit status."""

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from command_line import invoke, run_command, succeed

import chronoscene.cli.runs.bench as bench_module
from chronoscene.cli import cli
from chronoscene.errors import BackendError, ConfigError, SceneError
from chronoscene.harness.files.records import Failure
from chronoscene.harness.run.runner import BenchOutcome
from chronoscene.metrics.lpips_weights import BACKBONE_FILE

PLUGINS = Path(__file__).parents[2] / "harness" / "plugins"
IMAGES = {f"{folder}/{i}.png": period for period, folder in enumerate("ab") for i in range(3)}
TESTS = ["a/1.png", "b/1.png"]


def chronoscene(*arguments):
    """Run the command, which finds the toy methods, as its workers do."""
    with pytest.MonkeyPatch.context() as patch:
        path = os.pathsep.join(filter(None, [str(PLUGINS), os.environ.get("PYTHONPATH")]))
        patch.setenv("PYTHONPATH", path)
        patch.setattr("sys.path", [str(PLUGINS), *sys.path])
        return run_command(*arguments)


def test_bench_score_and_table(make_scene_folder, tmp_path, runs_here):
    scene = make_scene_folder(IMAGES, tests=TESTS, name="place")
    runs = tmp_path / "runs"
    done = chronoscene(
        "bench", scene, "--method", "toy_methods:MEAN,toy_methods:RAISES", "--out", runs,
        "--set", "mean.rate=0.25", "--iterations", "12", "--threads", "1",
    )  # fmt: skip
    assert done.exit_code == 1, done.stderr
    assert "place: PSNR [dB] (psnr), higher is better" in done.stdout
    assert "Mean (joint, balanced, iterations=12, rate=0.25)" in done.stdout
    assert (
        "failed: place, raises (joint, balanced, iterations=12), seed 0: RuntimeError"
        in done.stdout
    )
    for file in ("results.json", "rows.csv", "figures/place_comparison.png"):
        assert str(runs / file) in done.stdout and (runs / file).is_file()
    assert "[1/2] place: mean joint balanced iterations=12,rate=0.25 seed 0" in done.stderr
    assert "Traceback" not in done.stderr
    (record,) = json.loads((runs / "results.json").read_text())
    assert record["method"] == "mean" and record["iterations"] == 12

    again = chronoscene("score", runs)
    assert again.exit_code == 0, again.stderr
    assert "place/mean-joint-balanced-iterations=12,rate=0.25/seed0: unchanged" in again.stdout

    table = chronoscene("table", runs, "--format", "json", "--metric", "psnr")
    assert table.exit_code == 0, table.stderr
    entries = json.loads(table.stdout)["entries"]
    macro = [e["mean"] for e in entries if e["column"] == "macro"]
    assert macro == [record["aggregates"]["macro"]["psnr"]]


def test_figures_are_drawn_of_the_scenes_of_the_bench_alone(
    make_scene_folder, tmp_path, runs_here, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    options = ("--method", "toy_methods:MEAN", "--out", "runs", "--threads", "1")
    for name, tests in (("place", TESTS), ("square", ["a/2.png", "b/2.png"])):
        done = chronoscene("bench", make_scene_folder(IMAGES, tests=tests, name=name), *options)
        assert done.exit_code == 0, done.stderr
        assert "place: PSNR [dB] (psnr), higher is better" in done.stdout
        drawn = [line for line in done.stdout.splitlines() if line.endswith(".png")]
        assert drawn and all(f"runs/figures/{name}_" in line for line in drawn)


def test_runs_inside_a_scene_are_refused(make_scene_folder, tmp_path):
    scene = make_scene_folder(IMAGES, tests=TESTS, name="place")
    (tmp_path / "link").symlink_to(scene)
    before = sorted(scene.rglob("*"))
    for out, expected in (
        (scene / "runs", "a place outside the scene"),
        (scene, "a place outside the scene"),
        (tmp_path / "link" / "runs", "a place outside the scene"),
        (tmp_path, "a folder without the scene"),  # its runs would be in tmp_path / "place"
    ):
        with pytest.raises(ConfigError, match=f"^--out .*: expected {expected}"):
            bench_module.command.main(
                [str(scene), "--method", "3dgs", "--out", str(out)], standalone_mode=False
            )
    assert sorted(scene.rglob("*")) == before


def test_a_plug_in_in_the_current_folder(make_scene_folder, tmp_path):
    scene = make_scene_folder(IMAGES, tests=TESTS)
    source = (PLUGINS / "toy_methods.py").read_text().replace("toy_methods:", "my_method:")
    (tmp_path / "my_method.py").write_text(source)
    # A file that shadows a module of the standard library must do no harm in the worker.
    (tmp_path / "bisect.py").write_text("raise RuntimeError('shadowed')\n")
    code = "from chronoscene.cli import main; main()"
    line = ("bench", str(scene), "--method", "my_method:MEAN", "--out", "runs")
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, *line], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs/scene/mean-joint-balanced/seed0/run.json").is_file()


@pytest.fixture
def settings(monkeypatch):
    """What the command asks of the harness, which does nothing here."""
    seen = []

    def run_bench(asked, say):
        seen.append(asked)
        return BenchOutcome((), 0, ())

    monkeypatch.setattr(bench_module, "run_bench", run_bench)
    monkeypatch.setattr(bench_module, "read_failures", lambda runs: [])

    def settings_of(*arguments):
        succeed("bench", *arguments)
        return seen[-1]

    return settings_of


def test_scenes_in_folders_and_nearby(make_scene_folder, tmp_path, settings, monkeypatch):
    scenes = tuple(make_scene_folder(name=f"data/{name}") for name in ("one", "two"))

    def found(*arguments):
        return tuple(scene.path for scene in settings(*arguments, "--method", "3dgs").scenes)

    for given in (scenes, [tmp_path / "data"]):
        assert found(*map(str, given)) == scenes
    for here in (tmp_path, tmp_path / "data"):
        monkeypatch.chdir(here)
        assert found() == scenes
    monkeypatch.chdir(scenes[0])
    assert found("--out", str(tmp_path / "r")) == scenes[:1]


@pytest.mark.parametrize("command", [["bench", "--method", "3dgs"], ["stats"]])
def test_no_scene_nearby(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli, command)
    assert isinstance(result.exception, SceneError)
    assert "expected a scene, or scenes in this folder or in data/, found none" in str(
        result.exception
    )


def test_a_device_that_is_not_there_is_refused_before_anything_is_read(
    make_scene_folder, tmp_path, monkeypatch, set_gsplat
):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    reader = "chronoscene.harness.plan.scenes.read_bench_scene"
    monkeypatch.setattr(reader, lambda *args, **options: pytest.fail("read"))
    command = ["bench", str(make_scene_folder()), "--method", "3dgs", "--out", str(tmp_path / "r")]
    result = CliRunner().invoke(cli, [*command, "--device", "cuda"])
    assert isinstance(result.exception, BackendError)
    assert str(result.exception).startswith("--device cuda: expected a CUDA device")
    assert not (tmp_path / "r").exists()
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    set_gsplat("1.7.0")
    result = CliRunner().invoke(cli, [*command, "--device", "cuda"])
    assert str(result.exception).startswith("gsplat: expected version 1.5 or 1.6, found 1.7.0")
    assert not (tmp_path / "r").exists()
    result = CliRunner().invoke(cli, [*command, "--device", "cuda:3"])
    assert result.exit_code == 2 and "'cuda:3' is not one of 'auto', 'cpu', 'cuda'" in result.stderr
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("option", ["--budget", "--seed"])
def test_help_does_not_promise_equal_models_of_budgets(option):
    found = {o.opts[0]: o.help for o in bench_module.command.params if isinstance(o, click.Option)}
    assert "qual seeds" in found[option] and "not" in found[option]


def test_defaults(settings, make_scene_folder):
    scene = make_scene_folder()
    asked = settings(str(scene), "--method", "chronogs")
    assert [found.path for found in asked.scenes] == [scene]
    assert asked.methods == ("chronogs",)
    assert asked.strategies == () and asked.run.preset == "balanced"
    assert (
        asked.seeds == (0,)
        and asked.run.runs == Path("runs").resolve()
        and asked.run.max_width == 1600
    )
    assert (
        asked.run.iterations is None
        and asked.run.budget_seconds is None
        and asked.run.threads is None
    )
    assert asked.run.device == "auto" and asked.run.lpips_weights is None and not asked.overwrite
    assert (asked.jobs, asked.job_memory, asked.ray) == (None, None, None)


def test_devices_of_a_cluster_are_not_looked_for_here(settings, make_scene_folder, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    scene = str(make_scene_folder())
    asked = settings(scene, "--method", "3dgs", "--device", "cuda", "--ray", "auto")
    assert (asked.ray, asked.run.device) == ("auto", "cuda")


def test_every_option_arrives(settings, tmp_path):
    (tmp_path / BACKBONE_FILE).write_bytes(bytes(1_000_001))
    asked = settings(
        "a", "b", "--method", "3dgs, chronogs,3dgs", "--strategy", "joint,separate",
        "--preset", "fast", "--budget", "1m30s", "--iterations", "7", "--seeds", "2",
        "--seed", "5", "--set", "x=1", "--set", "chronogs.y=a=b", "--max-width", "320",
        "--threads", "3", "--device", "cpu", "--separate-iterations", "each",
        "--lpips-weights", str(tmp_path), "--out", "elsewhere", "--overwrite",
        "--dataset-format", "wat", "--period-by", "year",
        "--jobs", "4", "--job-memory", "1.5",
    )  # fmt: skip
    assert (asked.jobs, asked.job_memory, asked.ray) == (4, 1_500_000_000, None)
    found = [(scene.path, scene.name, scene.period_by) for scene in asked.scenes]
    assert found == [(Path("a"), "wat", "year"), (Path("b"), "wat", "year")]
    assert asked.methods == ("3dgs", "chronogs")
    assert asked.strategies == ("joint", "separate") and asked.run.preset == "fast"
    assert asked.run.budget_seconds == 90 and asked.run.iterations == 7 and asked.seeds == (5, 6)
    assert asked.run.overrides == {"x": "1", "chronogs.y": "a=b"}
    assert (asked.run.max_width, asked.run.threads, asked.run.device) == (320, 3, "cpu")
    assert asked.run.separate_iterations == "each" and asked.overwrite
    assert asked.run.lpips_weights == tmp_path and asked.run.runs == Path("elsewhere").resolve()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--strategy", "both"], "expected one of joint, pooled, separate"),
        (["--budget", "5"], "--budget: expected a positive time"),
        (["--set", "x"], "--set: expected KEY=VALUE"),
        (["--set", "x=1", "--set", "x=2"], "--set x: expected one value, found 1 and 2"),
        (["--method", "a,,b"], "--method: expected names separated by commas"),
    ],
)
def test_wrong_options_are_told(make_scene_folder, arguments, message):
    with pytest.raises(ConfigError, match=message):
        invoke("bench", make_scene_folder(), "--method", "chronogs", *arguments)


def test_unknown_methods_name_the_known_ones(make_scene_folder):
    done = chronoscene("bench", make_scene_folder(IMAGES, tests=TESTS), "--method", "chronosg")
    assert done.exit_code == 2
    assert done.stderr.startswith("error: --method: expected one of")
    assert "did you mean 'chronogs'" in done.stderr and "Traceback" not in done.stderr


def test_a_failed_bench_has_status_1(make_scene_folder, monkeypatch):
    failure = Failure(
        method="m", strategy="joint", preset="fast", scene="s", seed=0, reason="because"
    )
    monkeypatch.setattr(bench_module, "run_bench", lambda *a: BenchOutcome((), 0, (failure,)))
    monkeypatch.setattr(bench_module, "read_failures", lambda runs: [failure])
    result = invoke("bench", make_scene_folder(), "--method", "m")
    assert result.exit_code == 1
    assert "failed: s, m: because" in result.output


def test_a_protocol_gives_the_options_that_are_not_named(make_scene_folder, monkeypatch, tmp_path):
    images = {f"{task}/{i}.png": p for p, task in enumerate(("a", "b")) for i in range(3)}
    scene = make_scene_folder(images, name="kitchen")
    (scene / "sparse/split.txt").unlink()
    given = []
    monkeypatch.setattr(bench_module, "run_bench", lambda settings, log: given.append(settings))
    monkeypatch.setattr(bench_module, "report", lambda outcome, out: None)
    words = ("bench", str(scene), "--method", "clnerf", "--protocol", "wat")
    run_command(*words, "--out", tmp_path / "runs")
    run_command(*words, "--out", tmp_path / "runs", "--strategy", "joint")
    assert [settings.strategies for settings in given] == [("sequential",), ("joint",)]
    assert given[0].scenes[0].name == "wat" and given[0].run.protocol == "wat"
    refused = run_command(*words, "--out", tmp_path / "runs", "--max-width", "1600")
    assert refused.exit_code != 0 and "error: --max-width: expected 65536" in refused.stderr
