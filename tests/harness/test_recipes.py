"""The recipes of `baselines.external`, run with stand-ins that have the programs' command lines."""

import re
import subprocess
import sys
import tomllib
import venv
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from click.testing import CliRunner

import chronoscene.cli.methods.methods as methods_module
from baselines import external
from baselines.external import prepare
from chronoscene.errors import ProgramError
from chronoscene.formats import load_format, read_scene
from chronoscene.harness.files.records import read_run
from chronoscene.images.decoding import load_rgb
from chronoscene.methods import MethodSpec, build_config, load_spec
from chronoscene.metrics.psnr_ssim import psnr

ROOT = Path(__file__).parents[2]
STAND_INS = Path(__file__).parent / "plugins/foreign_programs.py"
SPECS = {name: spec for name, spec in vars(external).items() if isinstance(spec, MethodSpec)}

CONFIG = """optim_params: {
    iterations: 40_000,
    offset_lr_max_steps: 40_000,
    update_until: 20000,
}
"""


@pytest.fixture
def installed(tmp_path):
    """Options that name the stand-ins: programs on a path of their own, and a folder of source."""
    programs, source = tmp_path / "bin", tmp_path / "source of all"
    for folder in (programs, source / "config", source / "arguments/hypernerf"):
        folder.mkdir(parents=True)
    for command in ("ns-train", "ns-render", "ns-export"):
        run = f'exec "{sys.executable}" -I "{STAND_INS}" {command.replace("-", "_")} "$@"'
        (programs / command).write_text(f"#!/bin/sh\n{run}\n")
        (programs / command).chmod(0o755)
    (programs / "python").symlink_to(sys.executable)
    (source / "config/chronogs.yaml").write_text(CONFIG)
    (source / "arguments/hypernerf/default.py").write_text("ModelHiddenParams = dict()\n")

    def options(kind):
        for script in ("train", "render", "train_ngpgv2_CLNerf"):
            code = f"import runpy, sys\nsys.argv.insert(1, '{kind}_{script.partition('_')[0]}')\n"
            code += f"runpy.run_path({str(STAND_INS)!r}, run_name='__main__')\n"
            (source / f"{script}.py").write_text(code)
        return {"prefix": f"env PATH={programs}:/usr/bin:/bin", "source": str(source)}

    return options


@pytest.mark.parametrize(
    ("name", "kind", "shown"),
    [
        ("SPLATFACTO", "ns", ("a/0.png", "a/0.png", "a/0.png")),
        ("CHRONOGS", "chronogs", ("a/0.png", "b/0.png", "b/0.png")),
        ("FOUR_D_GAUSSIANS", "four_d", ("a/0.png", "b/0.png", "b/0.png")),
    ],
)
def test_a_recipe_leads_from_a_scene_to_a_row(
    bench_here, installed, scene_folder, name, kind, shown
):
    overrides = installed(kind)
    outcome, _ = bench_here(f"baselines.external:{name}", overrides=overrides, iterations=30)
    assert outcome.failures == ()
    (folder,) = outcome.finished
    record = read_run(folder)
    scene = read_scene(scene_folder)
    photos = {f.name: load_rgb(scene.image_path(f)) for f in scene.frames}
    views = [f.name for f in scene.select(split="test")]
    expected = np.mean([psnr(photos[a], photos[b]) for a, b in zip(shown, views, strict=True)])
    assert record.aggregates["micro"]["psnr"] == pytest.approx(expected)
    assert (record.iterations, record.primitives) == (30, 12)
    assert record.strategy == ("pooled" if name == "SPLATFACTO" else "joint")
    told = "4DGaussians (official) has one focal length per image, here +5.0% off in y"
    assert (told in record.notices) == (name == "FOUR_D_GAUSSIANS")


def test_clnerf_trains_one_period_after_the_other(bench_here, installed, scene_folder, tmp_path):
    scene = read_scene(load_format("wat").write(read_scene(scene_folder), tmp_path / "breville"))
    overrides = installed("clnerf")
    outcome, _ = bench_here(
        "baselines.external:CLNERF", scenes=(scene.root,), overrides=overrides, iterations=2000
    )
    assert outcome.failures == ()
    record = read_run(outcome.finished[0])
    photos = {f.name: load_rgb(scene.image_path(f)) for f in scene.frames}
    first = {f.period: f.name for f in reversed(scene.frames) if f.split == "train"}
    expected = [psnr(photos[first[f.period]], photos[f.name]) for f in scene.select(split="test")]
    assert record.aggregates["micro"]["psnr"] == pytest.approx(np.mean(expected))
    assert (record.iterations, record.primitives) == (2000, None)
    assert record.checkpoint_bytes == len("task 1")
    told = "CLNeRF (official) trains 2000 iterations for each of 2 periods, one after the other"
    assert told in record.notices


def test_test_views_that_a_program_does_not_take_are_refused(bench_here, installed):
    outcome, _ = bench_here("baselines.external:CLNERF", overrides=installed("clnerf"))
    (failure,) = outcome.failures
    assert (
        "in the format wat: expected those that programs with this format use: every 8th"
        in failure.reason
    )
    assert "chronoscene split SCENE --scene-out NEW" in failure.reason


def test_parts_of_an_epoch_are_refused(prepared, installed):
    source = installed("clnerf")["source"]
    with pytest.raises(ProgramError, match=r"expected a multiple of 1000, .* found 1500"):
        prepared("CLNERF", prepare.clnerf, "wat", source, iterations=1500)


def test_programs_without_a_seed_say_so(bench_here, installed):
    outcome, _ = bench_here(
        "baselines.external:CHRONOGS", overrides=installed("chronogs"), seeds=(3,)
    )
    record = read_run(outcome.finished[0])
    assert record.notices[-1].endswith("seed 3: ChronoGS (official) takes no seed")
    assert record.iterations == 40_000


def test_the_version_is_the_commit_of_the_source(bench_here, installed):
    overrides = installed("chronogs")
    git = ["git", "-C", overrides["source"], "-c", "user.name=x", "-c", "user.email=x@y"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "x"], check=True)
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    outcome, _ = bench_here("baselines.external:CHRONOGS", overrides=overrides)
    assert read_run(outcome.finished[0]).method_version == f"unpackaged; {commit.strip()}"


MINE = """
import os, shutil, sys
command, data, *others = sys.argv[1:]
if command == "train":
    assert others == "--iterations 500 --seconds 0 --seed 0".split()
    open("model.pt", "w").write("learned")
else:
    os.mkdir("renders")
    for test in open(f"{data}/sparse/0/test.txt").read().split():
        shutil.copy(f"{data}/images/00000.png", f"renders/{test}")
"""


def test_the_recipe_of_the_page_runs(bench_here, tmp_path, monkeypatch):
    """As it is printed, with a program in an environment without packages."""
    page = ROOT / "docs/guides/other-programs.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "recipe.py").write_text(code)
    (tmp_path / "mine.py").write_text(MINE)
    venv.create(tmp_path / "environment", with_pip=False, symlinks=True)
    monkeypatch.syspath_prepend(tmp_path)
    path = f"{tmp_path}/environment/bin:/usr/bin:/bin"
    overrides = {"source": str(tmp_path), "prefix": f"env PATH={path}"}
    outcome, _ = bench_here("recipe:SPEC", preset="fast", overrides=overrides)
    assert outcome.failures == ()
    record = read_run(outcome.finished[0])
    assert (record.title, record.iterations, record.checkpoint_bytes) == ("Mine", 500, 7)
    assert record.aggregates["micro"]["psnr"] > 10 and record.primitives is None


@pytest.fixture
def prepared(make_scene, tmp_path):
    """Call a preparation on the scene with other cameras."""

    def run(name, function, format, source, frames=None, iterations=None, **camera):
        spec = SPECS[name]
        overrides = {"source": str(source)} | ({"iterations": iterations} if iterations else {})
        config = build_config(spec, preset="balanced", overrides=overrides)
        scene = make_scene()
        frames = [
            replace(f, camera=replace(f.camera, camera_id=i + 1, **camera) if i else f.camera)
            for i, f in enumerate(frames or scene.frames)
        ]
        data, output = (Path(mkdtemp(dir=tmp_path), name) for name in ("data", "output"))
        output.mkdir()
        load_format(format).write(scene.with_frames(frames), data)
        return function(data, output, config)

    return run


def test_principal_points_that_are_ignored_are_told(prepared, installed):
    source = installed("chronogs")["source"]
    notices = prepared(
        "CHRONOGS", prepare.chronogs, "chronoscene", source, params=(20.0, 20.0, 10.0, 8.0)
    )
    assert "up to 2.0 pixels off the centre: chronoscene undistort --center" in notices[0]


def test_images_of_several_sizes_are_refused_where_the_program_has_one(prepared, installed):
    source = installed("four_d")["source"]
    with pytest.raises(ProgramError, match=r"images of one size, .* found 12 x 16, 24 x 16"):
        prepared("FOUR_D_GAUSSIANS", prepare.four_d_gaussians, "nerfstudio", source, width=12)


def test_a_single_test_view_is_refused_before_the_training(make_scene, prepared):
    scene = make_scene()
    assert prepared("SPLATFACTO", prepare.splatfacto, "nerfstudio", "") == []
    frames = [replace(f, split="test" if f.name == "a/2.png" else "train") for f in scene.frames]
    with pytest.raises(ProgramError, match="ns-render: expected at least two test views"):
        prepared("SPLATFACTO", prepare.splatfacto, "nerfstudio", "", frames=frames)


def test_source_code_that_is_not_there_is_named(prepared, installed, tmp_path):
    with pytest.raises(ProgramError, match=r"chronogs\.yaml: expected a file of the program"):
        prepared("CHRONOGS", prepare.chronogs, "chronoscene", tmp_path)


def test_another_version_of_the_config_is_refused(prepared, installed):
    source = installed("chronogs")["source"]
    Path(source, "config/chronogs.yaml").write_text("iterations: 30_000\n")
    with pytest.raises(ProgramError, match="expected a config with 40_000 iterations"):
        prepared("CHRONOGS", prepare.chronogs, "chronoscene", source)


def test_the_list_of_methods_tells_programs_apart(monkeypatch):
    names = {f"baselines.external:{name}": spec for name, spec in SPECS.items()}
    monkeypatch.setattr(
        methods_module, "method_names", lambda group="": tuple(names) if group else ("3dgs",)
    )
    monkeypatch.setenv("COLUMNS", "200")
    text = CliRunner().invoke(methods_module.command, [], catch_exceptions=False).output
    methods, _, programs = text.partition("External programs, installed apart from ChronoScene")
    assert "3dgs" in methods and "official" not in methods
    for spec in names.values():
        assert spec.name in programs and load_spec(f"baselines.external:{_variable(spec)}") is spec


def test_recipes_are_registered_under_their_names():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    registered = project["entry-points"]["chronoscene.programs"]
    assert {name: load_spec(place).name for name, place in registered.items()} == {
        spec.name: spec.name for spec in SPECS.values()
    }


def test_a_program_is_described_with_its_commands():
    arguments = ["baselines.external:CHRONOGS"]
    text = CliRunner().invoke(methods_module.command, arguments, catch_exceptions=False).output
    assert "external program, installed apart from ChronoScene; trained on an H200" in text
    assert "python '{source}/train.py' --config '{output}/config.yaml'" in text
    assert "prefix=\n    Words before each command" in text


def _variable(spec):
    return next(name for name, other in SPECS.items() if other is spec)
