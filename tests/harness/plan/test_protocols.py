"""Protocols: stand-ins in the form of each dataset, what is fixed, and what is refused."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from chronoscene.errors import ConfigError
from chronoscene.harness.files.protocols import PROTOCOLS
from chronoscene.harness.files.records import read_run
from chronoscene.harness.plan.plan import plan_runs
from chronoscene.harness.plan.settings import BenchSettings, bench_settings
from chronoscene.harness.report.published import load_published

TASKS = {f"{task}/{i:02d}.png": p for p, task in enumerate(("night", "sun")) for i in range(9)}
DAYS = {f"day_{p}_{i}.png": p for p in range(2) for i in range(5)}
DATES = {f"20{9 + p:02d}-0{i + 1}-01_{i}.png": p for p in range(2) for i in range(9)}


@pytest.fixture
def stand_in(make_scene_folder, tmp_path) -> Callable[[str], Path]:
    """A scene in the form of the data of a protocol."""

    def make(protocol: str) -> Path:
        images = {"wat": TASKS, "cl-splats": DAYS, "5pointz": DATES}[protocol]
        folder = make_scene_folder(images, name="kitchen")
        (folder / "sparse/split.txt").unlink()
        if protocol != "5pointz":
            return folder
        root = tmp_path / "5pointz"
        (root / "dense").mkdir(parents=True)
        shutil.move(folder / "images", root / "dense/images")
        shutil.move(folder / "sparse/0", root / "dense/sparse")
        (root / "annots").mkdir()
        (root / "annots/train.txt").write_text("\n".join(sorted(DATES)))
        return root

    return make


def settings(scene: Path, protocol: str, **changes) -> BenchSettings:
    """As the command makes them from its options."""
    given = PROTOCOLS[protocol].options() | changes
    given["strategies"] = (given["strategies"],)
    methods, runs = ("toy_methods:MEAN",), scene.parent / "runs"
    return bench_settings((scene,), methods, runs, protocol=protocol, **given)


@pytest.mark.parametrize(
    ("protocol", "tests", "strategy", "size"),
    [
        ("wat", ["night/00.png", "night/08.png", "sun/00.png", "sun/08.png"], "sequential", 1),
        ("cl-splats", ["day_0_0.png", "day_1_3.png"], "sequential", 1),
        ("5pointz", ["2009-01-01_0.png", "2010-02-01_1.png"], "joint", 4),
    ],
)
def test_a_stand_in_is_planned_as_published(stand_in, protocol, tests, strategy, size):
    scene = stand_in(protocol)
    plan = plan_runs(settings(scene, protocol), lambda line: None)
    ((folder, run),) = plan.todo.items()
    assert f"protocol={protocol}" in folder.parent.name
    assert run.document["config"]["protocol"] == protocol
    assert run.job.strategy == strategy
    read = run.job.origin.read_scene()
    assert [f.name for f in read.select(split="test")] == tests
    assert run.job.origin.shrink == size
    original = run.job.origin.model_copy(update={"shrink": 1}).read_scene()
    for small, large in zip(read.frames, original.frames, strict=True):
        assert small.camera.size == tuple(max(1, n // size) for n in large.camera.size)
        assert small.camera.K[0, 0] == pytest.approx(
            large.camera.K[0, 0] * small.camera.width / large.camera.width
        )


def test_a_run_outside_of_the_protocol_is_another(stand_in):
    scene = stand_in("cl-splats")
    free = bench_settings(
        (scene,), ("toy_methods:MEAN",), scene.parent / "runs", strategies=("sequential",)
    )
    ((usual, run),) = plan_runs(free, lambda line: None).runs.items()
    ((folder, other),) = plan_runs(settings(scene, "cl-splats"), lambda line: None).runs.items()
    assert usual != folder
    assert run.document["config_hash"] != other.document["config_hash"]
    assert "protocol" not in run.document["config"]


def test_records_of_other_programs_name_the_protocol_too(stand_in, bench_here):
    scenes, options = (stand_in("cl-splats"),), PROTOCOLS["cl-splats"].options()
    options["strategies"] = ("joint",)
    outcome, _ = bench_here("toy_programs:PROGRAM", scenes=scenes, protocol="cl-splats", **options)
    assert read_run(outcome.finished[0]).protocol == "cl-splats"


@pytest.mark.parametrize(
    ("protocol", "changes", "message"),
    [
        ("wat", {"strategies": "separate"}, "--strategy: expected sequential or joint, as"),
        ("cl-splats", {"max_width": 800}, "--max-width: expected 1600, as --protocol cl-splats"),
        ("wat", {"validation": True}, "--validation: expected the published test images, as"),
        ("wat", {"dataset_format": "colmap-folders"}, "expected the format wat, as --protocol wat"),
        ("5pointz", {"period_by": "month"}, "--period-by: expected year, as --protocol 5pointz"),
    ],
)
def test_what_contradicts_a_protocol_is_refused_by_name(stand_in, protocol, changes, message):
    with pytest.raises(ConfigError, match=message):
        settings(stand_in(protocol), protocol, **changes)


def test_every_protocol_has_its_printed_table():
    tables = {table.id: table for table in load_published().tables}
    for protocol in PROTOCOLS.values():
        assert len(tables[protocol.table].columns) == 1 + len(protocol.metrics)
