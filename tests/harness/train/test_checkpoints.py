"""Checkpoints are whole or not there, and a training goes on from them as if nothing had been."""

import errno
import json
import math
import os
import random
from contextlib import nullcontext

import numpy as np
import pytest
import torch

from chronoscene.errors import CheckpointError
from chronoscene.harness.files.records import CurvePoint
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train import checkpoints as module
from chronoscene.harness.train.checkpoints import Checkpoints, LoopState
from chronoscene.harness.train.loop import seed_everything, train
from chronoscene.io.staging import needing_space
from chronoscene.methods import import_object


def toy(name="Drawing", **options):
    config = import_object("toy_methods:Config")(**options)
    return import_object(f"toy_methods:{name}")(config)


@pytest.fixture
def make(tmp_path):
    """Makes those of a model; ``said`` collects its messages."""
    said = []

    def make(**changes):
        fields = {"settings": {"seed": 3}, "commit": "abc", "every": 0.0, "keep_last": False}
        fields["device"] = "cpu (Test, 1 thread)"
        fields |= {"folder": tmp_path / "training" / "all", "start": None, "log": said.append}
        return Checkpoints(**fields | changes)

    make.said = said
    return make


class Numbers:
    """A method that is one number."""

    value = 0.0

    def save_training(self, folder):
        (folder / "numbers.json").write_text(json.dumps([self.value] * 100))

    def load_training(self, folder):
        self.value = json.loads((folder / "numbers.json").read_text())[0]


def write(checkpoints, *numbers):
    for number in numbers:
        method = Numbers()
        method.value = float(number)
        checkpoints.write(method, LoopState(iterations=number, seconds=0.1 * number))


def restored(checkpoints):
    method = Numbers()
    state = checkpoints.restore(method)
    assert state is None or method.value == state.iterations
    return None if state is None else state.iterations


def test_everything_comes_back(make):
    checkpoints = make()
    assert restored(checkpoints) is None and not checkpoints.folder.exists()
    seed_everything(5)
    point = CurvePoint(0.1 + 0.2, 7, 10, math.nan, 100, "all")
    state = LoopState(iterations=9, seconds=1 / 3, curve=[point], empty_steps=2, skipped_steps=1)
    checkpoints.write(Numbers(), state)
    drawn = random.random(), np.random.normal(), float(torch.rand(()))
    seed_everything(6)
    found = make().restore(Numbers())
    assert found.seconds == 1 / 3 and math.isnan(found.curve[0].psnr)
    assert (found.empty_steps, found.skipped_steps, found.resumed) == (2, 1, 1)
    assert found.commits == ["abc"] and found.devices == ["cpu (Test, 1 thread)"]
    assert found.peak_memory_bytes > 10e6
    assert (random.random(), np.random.normal(), float(torch.rand(()))) == drawn
    assert json.loads((checkpoints.folder.parent / "config.json").read_text()) == {"seed": 3}
    assert make.said == ["going on from iteration 9"]


def test_two_are_kept_and_the_end_alone(make):
    checkpoints = make(keep_last=True)
    write(checkpoints, 8, 9, 10, 11)
    assert sorted(p.name for p in checkpoints.folder.iterdir()) == ["10", "11"]
    checkpoints.finish(Numbers(), LoopState(iterations=12))
    assert [p.name for p in checkpoints.folder.iterdir()] == ["12"]


@pytest.mark.parametrize("file", ["loop.json", "numbers.json"])
@pytest.mark.parametrize("damage", ["missing", "cut", "edited", "empty"])
def test_a_damaged_one_gives_way_to_the_one_before(make, file, damage):
    checkpoints = make()
    write(checkpoints, 3, 4)
    for number, expected in ((4, 3), (3, None)):
        path = checkpoints.folder / str(number) / file
        data = path.read_bytes()
        edited = data.replace(b'"format_version":1', b'"format_version":2').replace(b"0, ", b"9, ")
        changed = {"cut": data[: len(data) // 2], "edited": edited, "empty": b""}
        path.unlink() if damage == "missing" else path.write_bytes(changed[damage])
        if expected:
            assert restored(make()) == expected
            assert f"a checkpoint is not used: {path}" in make.said[0]
    with pytest.raises(CheckpointError, match=r"to go on from, found .*to train from the"):
        restored(make())


@pytest.mark.parametrize(
    "change",
    [
        {"random_state": {}},
        {"random_state": {"python": [3, [1], None], "numpy": [], "torch": ""}},
        {"random_state": {"python": None}},
        {"iterations": -1},
        {"seconds": "NaN"},
        {"files": {"a\0b": ""}},
        {"files": {"..": ""}},
    ],
    ids=str,
)
def test_a_state_that_no_training_has_gives_way_to_the_one_before(make, change):
    checkpoints = make()
    write(checkpoints, 3, 4)
    path = checkpoints.folder / "4/loop.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert restored(make()) == 3
    assert f"a checkpoint is not used: {checkpoints.folder / '4'}" in make.said[0]


def test_a_kill_at_any_moment_leaves_a_whole_one(make, monkeypatch):
    """Every call that changes the disk for good is the last one."""
    for number in range(100):
        write(make(folder=make().folder / str(number)), 1)
        calls = []

        def dying(function):
            def call(*args, **options):
                if len(calls) == number:  # noqa: B023
                    raise SystemExit
                calls.append(1)  # noqa: B023
                return function(*args, **options)

            return call

        with monkeypatch.context() as patch:
            for name in ("fsync", "replace", "open"):
                patch.setattr(module.os, name, dying(getattr(os, name)))
            patch.setattr(Numbers, "save_training", dying(Numbers.save_training))
            try:
                write(make(folder=make().folder / str(number)), 2)
            except SystemExit:
                pass
            else:
                break
        assert restored(make(folder=make().folder / str(number))) in (1, 2)
        assert not list(make().folder.glob(f"{number}/.*"))
    assert number > 8


@pytest.mark.parametrize("named", [True, False])
def test_a_full_disk_costs_one_checkpoint_and_not_the_training(make, monkeypatch, named):
    checkpoints = make()
    write(checkpoints, 1)

    def full(self, folder):
        (folder / "numbers.json").write_text("[")
        with needing_space(folder) if named else nullcontext():
            raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Numbers, "save_training", full)
        write(checkpoints, 2)
    (said,) = make.said
    assert said.startswith("note: no checkpoint of iteration 2: ") and "No space left" in said
    assert [p.name for p in checkpoints.folder.iterdir()] == ["1"]
    write(checkpoints, 3)
    assert restored(make()) == 3


def test_a_start_is_used_until_there_is_something_newer(make, tmp_path):
    write(make(folder=tmp_path / "short" / "all"), 5)
    longer = make(start=tmp_path / "short" / "all")
    assert restored(longer) == 5
    write(longer, 6)
    assert restored(longer) == 6
    with pytest.raises(CheckpointError, match="a checkpoint to go on from, found none"):
        restored(make(folder=tmp_path / "x", start=tmp_path / "nothing"))


def run(method, part, stop, checkpoints=None, **changes):
    for index in range(len(part.train.views)):
        part.train.load_image(index)  # so that no test depends on how long that takes
    truth = {f.name: (part.store.load(f), part.store.load_mask(f)) for f in part.test}
    options = {"seed": 0, "device": "cpu", "observer": lambda *step: None, **changes}
    return train(method, part, stop, truth, checkpoints=checkpoints, **options)


def dying_at(index):
    method = toy()
    step = method.step

    def stepped(i, progress):
        if i == index:
            raise SystemExit
        return step(i, progress)

    method.step = stepped
    return method


def test_a_training_that_was_stopped_anywhere_ends_alike(part, make):
    undisturbed = toy()
    expected = run(undisturbed, part, StopRule(30, None))
    for index in (1, 2, 15, 16, 29):
        with pytest.raises(SystemExit):
            run(dying_at(index), part, StopRule(30, None), make())
    method = toy()
    state = run(method, part, StopRule(30, None), make())
    assert method.colors.tolist() == undisturbed.colors.tolist()
    assert (state.iterations, state.resumed) == (30, 5)
    ours, theirs = ([(p.iteration, p.psnr) for p in s.curve] for s in (state, expected))
    assert ours == theirs
    seconds = [p.seconds for p in state.curve]
    assert seconds == sorted(seconds) and state.setup_seconds < seconds[0]


def test_a_budget_goes_on_with_the_seconds_that_are_used(part, make):
    write(make(), 40)  # which took 4 seconds
    method = toy()
    method.load_training = lambda folder: None
    done = run(method, part, StopRule(None, 4.0), make())
    assert (done.iterations, done.seconds) == (40, 4.0)
    state = run(method, part, StopRule(None, 4.01), make())
    assert state.iterations > 40 and state.seconds >= 4.01


def test_the_clock_goes_on_where_it_stopped_without_what_was_waited(part, make, clock):
    def timed(method):
        method.setup = clock.waits(3.0, part.store, clock.takes(2.0, method.setup))
        method.step = clock.waits(3.0, part.store, clock.takes(0.25, method.step))
        return method

    with pytest.raises(SystemExit):
        run(timed(dying_at(4)), part, StopRule(10, None), make(), now=clock)
    state = run(timed(toy()), part, StopRule(10, None), make(), now=clock)
    assert (state.resumed, state.iterations) == (1, 10)
    assert (state.setup_seconds, state.seconds, state.waited_seconds) == (2.0, 4.5, 33.0)


def test_no_checkpoint_is_made_of_a_training_in_trouble(part, make):
    method = toy("NotFinite")
    run(method, part, StopRule(20, None), make())
    numbers = sorted(int(p.name) for p in make().folder.iterdir())
    assert numbers == [4, 5]
