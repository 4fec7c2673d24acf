"""The progress of all long commands: a bar on a terminal, and plain lines elsewhere."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import rich.console
from command_line import invoke

from chronoscene.cli import progress
from chronoscene.cli.progress import format_rate, progress_bar, tracked


class Terminal(io.StringIO):
    """Takes what is drawn; `frames` are the lines of it without colours and cursor movements."""

    def isatty(self) -> bool:
        return True

    def frames(self) -> list[str]:
        plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.getvalue())
        return [line.strip() for line in re.split(r"[\r\n]+", plain) if line.strip()]


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(rich.console, "monotonic", clock)
    return clock


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    return Terminal()


def test_counts_rate_time_passed_and_time_left(terminal: Terminal, clock: Clock) -> None:
    with redirect_stderr(terminal), progress_bar() as bar:
        for done in range(7):
            bar("photos", done, 20)
            clock.now += 2
    assert re.fullmatch(r"photos \S+ +6/20 0\.5/s 0:00:14 < 0:00:28", terminal.frames()[-1])


def test_the_bar_goes_when_the_block_ends(terminal: Terminal) -> None:
    with redirect_stderr(terminal), progress_bar() as bar:
        bar("photos", 1, 2)
    assert terminal.getvalue().endswith("\x1b[1A\x1b[2K")  # a line up, and that line erased


def test_a_new_step_has_its_own_clock(terminal: Terminal, clock: Clock) -> None:
    with redirect_stderr(terminal), progress_bar() as bar:
        for done in range(4):
            bar("features", done, 3)
            clock.now += 60
        bar("pairs", 0, 3)
        clock.now += 1
    assert re.fullmatch(r"pairs \S+ 0/3 +0:00:01 < -:--:--", terminal.frames()[-1])


def test_a_count_that_goes_on_under_another_name_keeps_its_clock(
    terminal: Terminal, clock: Clock
) -> None:
    with redirect_stderr(terminal), progress_bar() as bar:
        for done, scene in enumerate(["Bund [1]", "Mall", "Plaza"]):
            bar(scene, done, 3)
            clock.now += 10
    assert re.fullmatch(r"Plaza \S+ 2/3 0\.1/s 0:00:30 < 0:00:10", terminal.frames()[-1])
    assert any(line.startswith("Bund [1] ") for line in terminal.frames())


def test_what_an_earlier_run_did_makes_nothing_faster(terminal: Terminal, clock: Clock) -> None:
    with redirect_stderr(terminal), progress_bar() as bar:
        for done in (900, 910, 920):
            bar("features", done, 1000)
            clock.now += 10
        bar("features", 930, 1000)
    assert " 930/1000 1/s 0:00:30 < 0:01:10" in terminal.frames()[-1]


def test_in_a_log_each_step_is_a_line(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: 100.0))
    with progress_bar("read scene") as bar:
        for what, total in (("features", 3), ("pairs", 123)):
            for done in range(total + 1):
                partial(bar, what)(done, total)
    assert list(tracked([1], "scenes")) == [1]
    lines = ["read scene", "features: 0 of 3", "pairs: 0 of 123", "scenes"]
    assert capfd.readouterr() == ("", "".join(f"{line}\n" for line in lines))


def test_in_a_log_a_long_step_is_told_twice_a_minute(
    capfd: pytest.CaptureFixture[str], clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=clock))
    for _ in tracked(range(12), "images"):
        clock.now += 10
    lines = [f"images: {done} of 12" for done in (0, 3, 6, 9)]
    assert capfd.readouterr() == ("", "".join(f"{line}\n" for line in lines))


@pytest.mark.parametrize(
    ("words", "begins"),
    [
        ("convert {scene} {out}", ["read {scene}", "images: 1 of 4"]),
        ("undistort {scene} {out}", ["read {scene}", "images: 1 of 4"]),
        ("split {scene} --scene-out {out}", ["read {scene}", "images: 1 of 4"]),
        ("validate {scene} --decode", ["check {scene}", "decode images: 0 of 4"]),
        ("validate {scene} --fix {out}", ["correct {scene}", "check {out}"]),
        ("stats {scene}", ["measure scenes"]),
        pytest.param(
            "synth {out} --preset tiny --views 4 --size 32x24",
            ["city", "photos: 2 of 12", "points: 9 of 12", "ground truth: 10 of 12"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_without_a_terminal_commands_say_what_they_begin(
    make_scene_folder: Callable[[], Path], tmp_path: Path, words: str, begins: list[str]
) -> None:
    places = {"scene": make_scene_folder(), "out": tmp_path / "out"}
    done = invoke(*words.format(**places).split())
    lines = done.stderr.splitlines()
    expected = [line.format(**places) for line in begins]
    assert [line for line in lines if line in expected] == expected
    assert not re.search(r"[\r\x1b]", done.stderr) and len(lines) <= 8


def test_tracked_items_are_counted_when_they_are_done_with(
    terminal: Terminal, clock: Clock
) -> None:
    passed = []
    with redirect_stderr(terminal):
        for item in tracked(iter("abcd"), "scenes", total=4):
            passed.append(item)
            clock.now += 5
    assert passed == list("abcd")
    assert re.fullmatch(r"scenes \S+ 4/4 0\.2/s 0:00:20 < 0:00:00", terminal.frames()[-1])


def test_nothing_to_track(terminal: Terminal) -> None:
    with redirect_stderr(terminal):
        assert list(tracked([], "scenes")) == []


@pytest.mark.parametrize(
    ("speed", "text"),
    [(None, ""), (0, ""), (0.0234, "0.023/s"), (2.5, "2.5/s"), (9.96, "10/s"), (1234.5, "1,234/s")],
)
def test_rate(speed: float | None, text: str) -> None:
    assert format_rate(speed) == text


@pytest.mark.parametrize(
    ("words", "news"),
    [
        ("convert {scene} {out}", ("images", 4, 4)),
        ("undistort {scene} {out}", ("images", 4, 4)),
        ("split {scene} --scene-out {out}", ("images", 4, 4)),
        ("validate {scene} --decode", ("decode images", 4, 4)),
        ("stats {scene}", ("measure scenes", 1, 1)),
        ("synth {out} --preset tiny --views 4 --size 32x24", ("ground truth", 12, 12)),
    ],
)
def test_commands_tell_their_progress(
    make_scene_folder: Callable[[], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: str,
    news: tuple[str, int, int],
) -> None:
    told: list[tuple[str, int, int]] = []

    @contextmanager
    def bar(first: str) -> Iterator[progress.Report]:
        yield lambda *call: told.append(call)

    terminal = SimpleNamespace(stderr=SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(progress, "sys", terminal)
    monkeypatch.setattr(progress, "_bar", bar)
    done = invoke(*words.format(scene=make_scene_folder(), out=tmp_path / "out").split())
    assert done.exit_code in (0, 1) and news in told
