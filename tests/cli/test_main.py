"""The command starts quickly, lists its commands, and turns our errors into one line."""

import errno
import os
import signal
import subprocess
import sys
import time

import click
import pytest
from command_line import invoke, refused, run_command
from fresh_process import loaded_by, run_python

import chronoscene.cli as cli_package
from chronoscene.cli import COMMANDS, SECTIONS, cli
from chronoscene.errors import SceneError


def test_help_lists_every_command():
    result = invoke("--help")
    assert result.exit_code == 0
    for name in COMMANDS:
        assert f"\n  {name} " in result.output


def test_summaries_are_the_first_sentences_of_the_help_of_commands():
    context = click.Context(cli)
    for commands in SECTIONS.values():
        for name, (_, summary) in commands.items():
            assert summary == cli.get_command(context, name).get_short_help_str(limit=64)
            assert summary.endswith(".") and not summary.endswith("..")


def test_the_package_can_be_run():
    command = [sys.executable, "-m", "chronoscene", "--version"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.startswith("chronoscene, version "), done.stderr


def test_unknown_command_is_a_usage_error():
    result = invoke("frobnicate")
    assert result.exit_code == 2
    assert "No such command" in result.output


def test_our_errors_become_one_line_and_status_2(monkeypatch):
    @click.command("boom")
    def boom() -> None:
        raise SceneError("scene", expected="a model", found="nothing", todo="add one")

    monkeypatch.setattr(cli_package.cli, "get_command", lambda ctx, name: boom)
    assert refused("boom") == "error: scene: expected a model, found nothing; add one\n"


def test_a_full_disk_is_one_line_too(monkeypatch):
    @click.command("boom")
    def boom() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "runs/results.json")

    monkeypatch.setattr(cli_package.cli, "get_command", lambda ctx, name: boom)
    told = refused("boom")
    assert told.startswith("error: runs/results.json: expected space for what is written there, ")
    assert "found No space left on device; free space" in told
    assert told.count("\n") == 1


def test_a_command_that_is_asked_to_end_leaves_nothing_behind(tmp_path):
    code = "from chronoscene.cli import main; main()"
    arguments = ["synth", str(tmp_path / "out"), "--preset", "demo"]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    while process.poll() is None and not any(tmp_path.rglob("*.*")):
        time.sleep(0.01)
    process.terminate()
    _, told = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, told
    assert "Traceback" not in told
    assert told.endswith("terminated; what was finished before is kept\n")
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


@pytest.mark.skipif(os.name != "posix", reason="needs a shell of POSIX")
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_standard_streams_may_be_closed(make_scene_folder, closed):
    command = f"{sys.executable} -m chronoscene stats {make_scene_folder()}"
    result = subprocess.run(["sh", "-c", f"{command} {closed}"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stderr in ("measure scenes\n", "")
    assert ("Period" in result.stdout) == (">&-" not in closed.split())


def test_dataset_commands_work_without_what_windows_lacks(make_scene_folder, tmp_path):
    scene = make_scene_folder()
    code = """
import os, signal, sys
sys.modules.update(dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios")))
for module, names in (
    (os, ("fork", "killpg", "register_at_fork", "sched_getaffinity", "setsid")),
    (signal, ("SIGKILL", "SIGHUP", "pthread_sigmask")),
):
    for name in names:
        delattr(module, name)
from importlib import import_module
from chronoscene.cli import COMMANDS, cli
for place in COMMANDS.values():
    import_module(place.partition(":")[0])
scene, out = sys.argv[1:]
for words in (["validate", scene], ["stats", scene], ["convert", scene, out]):
    cli.main(words, standalone_mode=False)
"""
    run_python(code, scene, tmp_path / "out")
    assert (tmp_path / "out/sparse/split.txt").is_file()


def test_help_imports_nothing_heavy():
    code = "from chronoscene.cli import cli\ntry: cli.main(['--version'])\nexcept SystemExit: pass"
    assert not loaded_by(code) & {"torch", "numba", "cv2", "pandas", "pycolmap"}


def test_an_interruption_does_not_exit_like_a_failure(monkeypatch):
    @click.command("stopped")
    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli_package.cli, "get_command", lambda ctx, name: stopped)
    done = run_command("stopped")
    assert done.exit_code == 130 and "interrupted" in done.stderr


@pytest.mark.parametrize(("status", "code"), [(0, 0), (1, 1)])
def test_a_verdict_sets_the_exit_status(monkeypatch, status, code):
    @click.command("judged")
    @click.pass_context
    def judged(context: click.Context) -> None:
        context.exit(status)

    monkeypatch.setattr(cli_package.cli, "get_command", lambda ctx, name: judged)
    assert run_command("judged").exit_code == code
