"""What is shown while a method trains."""

import io

import pytest
from rich.console import Console

from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.run import progress
from chronoscene.harness.run.progress import RunsDisplay
from chronoscene.harness.train import progress as display_module
from chronoscene.harness.train.progress import ProgressDisplay
from chronoscene.io.wording import format_time
from chronoscene.methods import StepReport


def shown(live, width=200):
    buffer = io.StringIO()
    console = Console(file=buffer, force_terminal=live, width=width, color_system=None)
    with ProgressDisplay("plaza: toy [x]", console) as display:
        display.wait("warm-up")
        display.begin("all", StopRule(100, None))
        for i, psnr in enumerate([None, 20.0, 20.0, 21.0], start=1):
            display.update(25 * i, 5.0 * i, StepReport(0.5, 1234), psnr)
        display.begin("period-1", StopRule(None, 60.0))
        display.update(12345, 6.0, StepReport(0.25, 7), 30.0)
    return buffer.getvalue()


def test_without_a_terminal_each_probe_is_a_line():
    assert shown(False).splitlines() == [
        "plaza: toy [x]: warm-up",
        "plaza: toy [x]: training",
        "plaza: toy [x]:  50% iteration 50, loss 0.5000, 20.00 dB, 5.0 it/s, 0:10 left, "
        "1234 primitives",
        "plaza: toy [x]: 100% iteration 100, loss 0.5000, 21.00 dB, 5.0 it/s, 1234 primitives",
        "plaza: toy [x] period-1: training",
        "plaza: toy [x] period-1:  10% iteration 12345, loss 0.2500, 30.00 dB, 2057.5 it/s, "
        "0:54 left, 7 primitives",
    ]


def test_without_a_terminal_a_line_a_minute_shows_that_it_goes_on(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(display_module.time, "monotonic", lambda: now[0])
    buffer = io.StringIO()
    with ProgressDisplay("plaza: toy", Console(file=buffer, width=200)) as display:
        display.begin("all", StopRule(1000, None))
        for i in range(1, 16):
            now[0] = 10.0 * i
            display.update(i, now[0], StepReport(0.5, 12), 20.0 if i > 5 else None)
    lines = [line.split(",")[0] for line in buffer.getvalue().splitlines()]
    steps = (6, 13)  # a probe, and a minute later
    assert lines == [
        "plaza: toy: training",
        *(f"plaza: toy: {i / 1000:4.0%} iteration {i}" for i in steps),
    ]


def test_on_a_narrow_terminal_there_is_a_bar_with_everything():
    text = shown(True, width=90)
    for part in ("period-1", "10%", "iteration 12345,", "loss 0.2500", "30.00 dB", "0:54 left"):
        assert part in text
    assert "━" in text


ESCAPE = "\x1b]0;title\x07\x1b[3J\u202e"
"""Names of strangers may be commands to a terminal."""


@pytest.mark.parametrize("live", [False, True])
def test_names_are_text_to_a_terminal(live):
    buffer, lines = io.StringIO(), []
    console = Console(file=buffer, force_terminal=live, width=200, color_system=None)
    with ProgressDisplay(f"plaza{ESCAPE}: toy", console) as display:
        display.wait(f"trains {ESCAPE}")
        display.begin("all", StopRule(100, None))
        display.log(f"no checkpoint: {ESCAPE}")
    with RunsDisplay(1, lines.append, console) as runs, runs.showing() as report:
        report(f"note: {ESCAPE}", 0, 0)
    assert r"plaza\x1b]0;title\x07\x1b[3J\u202e" in buffer.getvalue()
    assert not any(sign in buffer.getvalue() for sign in ("\x1b]", "\x07", "\x1b[3J", "\u202e"))


def test_the_loss_is_smoothed():
    display = ProgressDisplay("x", Console(file=io.StringIO()))
    display.begin("all", StopRule(10, None))
    display.update(1, 1.0, StepReport(1.0, 1), None)
    display.update(2, 2.0, StepReport(0.0, 1), None)
    assert "loss 0.9500" in display.status(2, 2.0, None)


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0:00"), (59.6, "1:00"), (61, "1:01"), (3661, "1:01:01")]
)
def test_times(seconds, text):
    assert format_time(seconds) == text


def test_a_run_among_others_reports_its_share_and_notes(monkeypatch, capsys):
    told = []
    monkeypatch.setattr(display_module, "REPORTING", -1.0)
    with ProgressDisplay("x", report=lambda *what: told.append(what), models=2) as display:
        display.wait("warm-up")
        for name in ("period-0", "period-1"):
            display.begin(name, StopRule(10, None))
            display.update(5, 1.0, StepReport(0.5, 7), 20.0)
        display.log("going on")
    shares = [(done, total) for _, done, total in told]
    assert shares == [(250, 1000), (750, 1000), (0, 0)] and told[-1][0] == "x period-1: going on"
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("live", [True, False])
def test_several_runs_have_one_bar(live):
    buffer, said = io.StringIO(), []
    console = Console(file=buffer, force_terminal=live, width=100, color_system=None)
    display = RunsDisplay(4, said.append, console)
    with display, display.showing() as report, display.showing() as other:
        report("iteration 1", 100, 1000)
        report("iteration 5", 500, 1000)
        other("b: a note [x]", 0, 0)
        display._bar.refresh()
        status = display.status(0.5)
    assert status.startswith("0 of 4 runs, 2 under way, ") and status.endswith(" left")
    if live:
        assert " 12% 0 of 4 runs, 2 under way" in buffer.getvalue() and said == []
        assert "b: a note [x]" in buffer.getvalue() and "2 of 4 runs, 0 under" in buffer.getvalue()
    else:
        assert [line[:25] for line in said] == [
            "b: a note [x]",
            "1 of 4 runs, 1 under way,",
            "2 of 4 runs, 0 under way,",
        ]


def test_runs_without_a_result_are_not_in_the_rate_of_several_runs(monkeypatch):
    now, said = [0.0], []
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with RunsDisplay(4, said.append, Console(file=io.StringIO())) as display:
        for seconds in (0.0, 0.1):
            now[0] += seconds
            with display.showing() as report:
                display.leave_out(report)
        with display.showing():
            now[0] = 60.0
    assert said == [
        "1 of 4 runs, 0 under way",
        "2 of 4 runs, 0 under way",
        "3 of 4 runs, 0 under way, 60.0 runs/h, 1:00 left",
    ]


def test_what_was_trained_before_is_not_in_the_rate_of_several_runs(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    display = RunsDisplay(2, print, Console(file=io.StringIO()))
    with display, display.showing() as report:
        report("iteration 500", 500, 1000)
        now[0] = 60.0
        assert display.status(0.5) == "0 of 2 runs, 1 under way"
        report("iteration 750", 750, 1000)
        assert display.status(0.75).endswith("15.0 runs/h, 5:00 left")
