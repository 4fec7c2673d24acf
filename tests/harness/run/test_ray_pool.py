"""Runs on a Ray cluster of several machines, one of which sees none of the others' files.

By default, a stand-in for Ray does at once in this process what it is told; starting a cluster
takes half a minute.
"""

import os
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace

import psutil
import pytest
from training_here import execute_here
from waiting import wait_for

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import read_run
from chronoscene.harness.files.source import RunOrigin
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run import ray_pool
from chronoscene.harness.run.runner import run_bench
from chronoscene.harness.train.worker import execute
from chronoscene.io.processes import process_tree

from ..plan.test_job import JOB

NODE = {"object_store_memory": 80_000_000, "include_dashboard": False}

ON_RAY = pytest.mark.parametrize(
    "address", [pytest.param("ray", marks=pytest.mark.slow)], indirect=True
)
"""For what needs the processes of a cluster."""


@pytest.fixture(scope="module")
def cluster(toys, tmp_path_factory):
    """Two machines with one processor each, which share our files."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory(prefix="ray") as place:
        patch.setenv("RAY_TMPDIR", place)  # names of sockets are short
        hold = tmp_path_factory.mktemp("hold") / "hold"
        patch.setenv("TOY_HOLD", f"7:{hold}")
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **NODE})
        try:
            for _ in range(2):
                cluster.add_node(num_cpus=1, memory=10**9, **NODE)
            cluster.hold = hold
            yield cluster
        finally:
            cluster.shutdown()


@pytest.fixture(autouse=True)
def bounded():
    """A cluster that does not answer fails a test, and does not stop the others."""

    def late(number, frame):
        raise TimeoutError("the test took longer than five minutes")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(300)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


class StandIn:
    """Part of Ray that `RayPool` uses, with two machines of one processor."""

    exceptions = SimpleNamespace(RayError=ConnectionError, RayActorError=ConnectionResetError)

    def init(self, address, **options):
        assert address == "auto"

    def shutdown(self):
        pass

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": 1.0, "memory": 1e9}}] * 2

    def remote(self, kind):
        return SimpleNamespace(
            options=lambda **needs: SimpleNamespace(remote=lambda: Actor(kind()))
        )

    def wait(self, references, timeout):
        return references, []

    def get(self, reference):
        return reference.result()

    def kill(self, actor):
        pass


class Actor:
    """The methods of an object, called by ``remote``."""

    def __init__(self, owner):
        self.owner = owner

    def __getattr__(self, name):
        def call(*arguments):
            done = Future()
            try:
                done.set_result(getattr(self.owner, name)(*arguments))
            except Exception as error:
                done.set_exception(error)
            return done

        return SimpleNamespace(remote=call)


@pytest.fixture(params=["stand-in", pytest.param("ray", marks=pytest.mark.slow)])
def address(request, monkeypatch):
    """The address of a cluster."""
    if request.param == "ray":
        return request.getfixturevalue("cluster").address
    monkeypatch.setattr(ray_pool, "import_extra", lambda *names: StandIn())
    monkeypatch.setattr(
        ray_pool, "run_staged", lambda job, report, stop: execute(job.document(), report)
    )
    return "auto"


@pytest.fixture
def on_ray(address, scene_folder, tmp_path):
    """Run a bench on the cluster; returns its outcome and what it said."""

    def run(*methods, **changes):
        said = []
        settings = {
            "scenes": (scene_folder,),
            "methods": tuple(f"toy_methods:{name}" for name in methods),
            "runs": tmp_path / "runs",
            "threads": 1,
            "job_memory": 10**8,
            "ray": address,
        }
        return run_bench(bench_settings(**{**settings, **changes}), said.append), said

    return run


def files_of(folder):
    """All files of a run with their contents, but for those with times."""
    files = {str(p.relative_to(folder)): p for p in folder.rglob("*") if p.is_file()}
    timed = ("run.json", "curve.csv", "loop.json")
    return {n: p.name in timed or p.read_bytes() for n, p in files.items()}


@pytest.mark.parametrize(
    "methods",
    [
        ("toy_methods:DRAWING",),
        pytest.param(("toy_methods:DRAWING", "3dgs"), marks=pytest.mark.slow),
    ],
)
def test_results_are_those_of_a_local_run(on_ray, scene_folder, tmp_path, methods):
    names = {"methods": methods, "iterations": 12, "keep_training": True}
    outcome, said = on_ray(**names)
    assert outcome.failures == ()
    assert sum(" seed 0: on " in line for line in said) == len(methods)
    assert not list(tmp_path.rglob("*.partial")) and not list(tmp_path.rglob("*.token"))
    local = {"scenes": (scene_folder,), "runs": tmp_path / "local", "threads": 1}
    for found in outcome.finished:
        method = methods["3dgs" in found.parent.name]
        (one,) = run_bench(
            bench_settings(**local, **{**names, "methods": (method,)}),
            lambda line: None,
            execute=execute_here,
        ).finished
        assert files_of(found) == files_of(one)
        ours, theirs = read_run(one), read_run(found)
        assert theirs.aggregates == ours.aggregates and theirs.commit == ours.commit
    begun = {**names, "methods": methods[:1], "iterations": None}
    longer, _ = on_ray(**begun, continue_to=20)
    assert longer.failures == () and read_run(longer.finished[0]).iterations == 20


@ON_RAY
def test_a_run_that_fails_stops_nobody_else(on_ray):
    outcome, said = on_ray("FULL_DISK", "RAISES", "KILLED", "ORPHANED", "MEAN")
    assert [folder.parent.name for folder in outcome.finished] == ["mean-joint-balanced"]
    reasons = {failure.method: failure.reason for failure in outcome.failures}
    assert "full-disk-joint-balanced/seed0: expected space for what is" in reasons["full-disk"]
    assert reasons["raises"] == "RuntimeError: the toy is broken (see error.log)"
    assert "signal SIGKILL" in reasons["killed"]
    assert reasons["orphaned"].startswith(
        "the machine that ran it was lost, or its process there: "
    )
    assert said[-1].startswith("5 of 5 runs, 0 under way, ")
    outcome, _ = on_ray("MEAN", threads=5, seeds=(1,))
    wanted = "expected a machine with 5 processors and 0.10 GB of memory, found none"
    assert wanted in outcome.failures[0].reason


@ON_RAY
def test_other_code_is_told_and_another_version_refused(on_ray, monkeypatch):
    monkeypatch.setattr(ray_pool, "code_version", lambda: "another")
    outcome, said = on_ray("MEAN", seeds=(0, 1))
    notes = [line for line in said if "this machine that of another" in line]
    assert len(notes) == 1 and read_run(outcome.finished[0]).commit in notes[0]
    monkeypatch.setattr(ray_pool.chronoscene, "__version__", "0.0")
    with pytest.raises(ConfigError, match=r"expected chronoscene 0\.0 on every machine, found"):
        on_ray("BLIND")


def test_a_machine_that_does_not_see_the_runs_is_refused(on_ray, monkeypatch):
    monkeypatch.setattr(ray_pool, "write_text_atomic", lambda path, text: None)
    with pytest.raises(ConfigError, match=r"expected a machine that sees .*runs, found one that"):
        on_ray("MEAN")


SCRIPT = """
import sys
from pathlib import Path
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.runner import run_bench
run_bench(
    bench_settings(
        scenes=(Path(sys.argv[1]),),
        methods=("toy_methods:MEAN", "toy_methods:BLIND"),
        runs=Path(sys.argv[2]),
        seeds=(7,),
        job_memory=10**8,
        ray=sys.argv[3],
    ),
    print,
)
"""


def workers():
    """Processes of runs that we, or the cluster, which we have started, have started."""
    found = []
    for pid in process_tree([os.getpid()]):
        words = psutil.Process(pid).cmdline()
        found += [pid] if "chronoscene.harness.train.worker:execute" in words else []
    return found


@ON_RAY
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_runs_end_with_their_bench(number, on_ray, cluster, scene_folder, tmp_path):
    runs, hold = tmp_path / "runs", cluster.hold
    hold.touch()
    driver = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(scene_folder), str(runs), cluster.address]
    )
    try:
        wait_for(lambda: len(list(runs.glob("ring/*/.seed7.*.partial/config.json"))) == 2)
        started = workers()
    finally:
        driver.send_signal(number)
        driver.wait(60)
    assert len(started) == 2
    wait_for(lambda: not process_tree(started), seconds=10.0)
    assert bool(list(runs.rglob("*.partial"))) == (number == signal.SIGKILL)
    hold.unlink()
    if number == signal.SIGKILL:
        outcome, _ = on_ray("MEAN", "BLIND", seeds=(7,))
        assert len(outcome.finished) == 2 and not list(tmp_path.rglob("*.partial"))


@pytest.mark.slow
def test_without_ray_or_a_cluster(scene_folder, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    settings = bench_settings(
        (scene_folder,), ("toy_methods:MEAN",), tmp_path / "runs", ray="127.0.0.1:1"
    )
    with pytest.raises(
        ConfigError,
        match=r"--ray 127.*: expected the address of a Ray cluster, .*, found .*refused",
    ):
        run_bench(settings, lambda line: None)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"--ray 127.*: expected the package ray"):
        run_bench(settings, lambda line: None)
    assert not list(tmp_path.rglob("*.token"))


def test_runs_get_what_the_machines_of_a_cluster_have(tmp_path):
    machines = [{"CPU": 16.0, "GPU": 1.0}, {"CPU": 6.0}, {"memory": 1.0}]
    nodes = [{"Alive": True, "Resources": machine} for machine in machines]
    nodes.append({"Alive": False, "Resources": {"CPU": 2.0}})

    def pool(**changes):
        settings = bench_settings((), (), tmp_path, ray="auto", **changes)
        return ray_pool.RayPool(SimpleNamespace(nodes=lambda: nodes), settings, tmp_path)

    assert pool().at_once == 3 and pool(threads=4).at_once == 5 and pool(jobs=2).at_once == 2
    either, toy = RunOrigin(method="3dgs", scene_root="", scene_format=""), JOB.origin
    job = replace(JOB, origin=either).with_settings(device="auto")
    assert pool()._on_gpu(job) and pool()._on_gpu(job.with_settings(device="cuda"))
    assert not pool()._on_gpu(job.with_settings(device="cpu")) and not pool()._on_gpu(JOB)
    machines[0].pop("GPU")
    assert not pool()._on_gpu(job) and not pool()._on_gpu(replace(job, origin=toy))
