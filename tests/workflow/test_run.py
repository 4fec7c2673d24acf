"""Steps are run once, continued, made anew where something changed, and never mixed."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from chronoscene.cli.runs.all import command
from chronoscene.errors import ChronoSceneError, ConfigError, RegistrationError, SceneError
from chronoscene.workflow import steps
from chronoscene.workflow.run import start
from chronoscene.workflow.steps import STEPS

NAMES = [step.name for step in STEPS]
MADE = [name for name in NAMES if name != "survey"]
"""Steps that the project of the tests can do."""


def test_all_steps_are_run_once(fake):
    said = fake.go()
    assert fake.calls == NAMES
    assert fake.states == dict.fromkeys(MADE, "done") | {"survey": "skipped"}
    lines = "\n".join(said)
    assert said[0] == "" and "[1/6] register: done in " in lines
    assert "[6/6] survey: skipped, the scene has no scale" in said
    said = fake.go()
    assert fake.calls == ["survey"]  # it may have become possible
    assert "[3/6] bench: kept, made in " in "\n".join(said)


@pytest.mark.parametrize("step", MADE)
def test_a_failure_keeps_what_is_finished(fake, step):
    fake.broken = step
    with pytest.raises(RegistrationError):
        fake.go()
    before = NAMES[: NAMES.index(step)]
    assert fake.states == dict.fromkeys(before, "done") | {step: "failed"}
    assert f'Stopped at <span class="badge fail">{step}' in fake.html
    assert "found none; add &lt;photos&gt;" in fake.html
    fake.broken = ""
    fake.go()
    assert fake.calls == NAMES[NAMES.index(step) :]
    assert "Stopped" not in fake.html


def test_an_interruption_is_recorded(fake, monkeypatch):
    def stop(project):
        raise KeyboardInterrupt

    monkeypatch.setattr(fake, "bench", stop, raising=False)
    with pytest.raises(KeyboardInterrupt):
        fake.go()
    assert fake.states["bench"] == "failed"
    assert "stopped before its end" in fake.html


def test_another_command_in_the_same_folder_is_refused(fake, monkeypatch):
    monkeypatch.setattr(fake, "bench", lambda project: fake.go(), raising=False)
    with pytest.raises(ConfigError, match=r"OUT .*: expected a folder in which no other command"):
        fake.go()


def test_another_option_renews_what_follows_from_it(fake):
    fake.go()
    said = fake.go(budget="5m")
    assert said[0] == (
        "changed: --budget 5m instead of left out; made anew: bench, page, export, survey"
    )
    assert fake.calls == ["bench", "page", "export", "survey"]
    assert "--budget 5m" in fake.html


def test_what_lies_beside_a_table_is_no_photo(fake):
    rows = "photos/2016/1.jpg,2016\nphotos/2023/1.jpg,2023\n"
    (fake.root / "dates.csv").write_text(f"image,period\n{rows}")
    fake.go()
    assert {*fake.recorded["photos"]} == {"dates.csv", "photos/2016/1.jpg", "photos/2023/1.jpg"}
    assert fake.go()[0] == "" and fake.calls == ["survey"]
    (fake.photos / "2023/1.jpg").write_text("another")
    assert fake.go()[0].startswith("changed: 1 file changed; made anew: ")
    with pytest.raises(ConfigError, match="expected a place outside the scene"):
        start(fake.captures, None, fake.photos / "out", {"preset": "fast", "budget": None})


def test_other_photos_renew_everything_that_changes(fake):
    fake.go()
    (fake.photos / "2023/2.jpg").touch()
    (fake.photos / "2016/2.jpg").unlink()
    (fake.photos / "2016/1.jpg").write_text("another")
    fake.poses = "second"
    said = fake.go()
    assert said[0] == (
        "changed: 1 file added, 1 file removed, 1 file changed; made anew: " + ", ".join(NAMES)
    )
    assert fake.calls == NAMES


def test_photos_that_give_the_same_scene_renew_nothing_else(fake):
    fake.go()
    (fake.photos / "2016/1.jpg").write_text("the same photo with other metadata")
    fake.go()
    assert fake.calls == ["register", "survey"]


def test_the_same_photos_from_another_folder_are_the_same(fake, monkeypatch):
    fake.go()
    (fake.out / "register/out/sparse/0/images.bin").write_text("mended")
    monkeypatch.chdir(fake.photos)
    monkeypatch.setattr(type(fake), "photos", Path())
    assert fake.go()[0] == ""
    assert fake.calls == NAMES[1:]


def test_masks_and_the_table_are_inputs(fake):
    fake.go()
    (fake.root / "masks/2016").mkdir(parents=True)
    (fake.root / "masks/2016/1.jpg.png").touch()
    assert fake.go()[0].startswith("changed: 1 file added; ")


def test_the_folder_may_be_renamed(fake, monkeypatch):
    fake.go()
    fake.out.rename(fake.root / "site")
    monkeypatch.setattr(type(fake), "out", fake.root / "site")
    assert fake.go()[0] == "" and fake.calls == ["survey"]
    assert "<title>site" in fake.html and "PSNR" in fake.html
    (fake.photos / "2016/2.jpg").unlink()
    fake.poses = "second"
    fake.go()
    assert fake.calls == NAMES and (fake.out / "register/site/registration.json").is_file()


def test_old_results_are_not_shown_beside_new_ones(fake):
    fake.go()
    assert 'href="page/index.html"' in fake.html and "PSNR" in fake.html
    (fake.photos / "2016/2.jpg").unlink()
    fake.poses, fake.broken = "second", "validate"
    with pytest.raises(RegistrationError):
        fake.go()
    assert 'href="page/index.html"' not in fake.html and "PSNR" not in fake.html
    assert "registration.html" in fake.html


@pytest.mark.parametrize("lost", ["export/2023 & more.ply", "page/period-1.png"])
def test_a_result_that_is_missing_is_made_again(fake, lost):
    fake.go()
    (fake.out / lost).unlink()
    fake.go()
    assert fake.calls == [lost.partition("/")[0], "survey"]


def test_a_registration_that_was_mended_by_hand_is_taken_over(fake):
    fake.go()
    (fake.out / "register/out/sparse/0/images.bin").write_text("mended")
    fake.go()
    assert fake.calls == NAMES[1:]


def test_a_failed_alignment_is_not_trained_on(fake, monkeypatch):
    fake.verdict = "fail"
    monkeypatch.setattr(fake, "bench", steps._bench, raising=False)
    with pytest.raises(RegistrationError, match="found the verdict fail: In <words>; ") as stopped:
        fake.go(budget="3m")
    commands = [line for line in str(stopped.value).splitlines() if line.startswith("  ")]
    scene = fake.out / "register/out"
    runs = commands[1].rpartition(" ")[2]
    assert runs.startswith(f"{fake.out}/bench/500px-")
    assert commands == [
        f"  chronoscene register {fake.photos} {scene} --overwrite --report "
        "--tie-points clicks.csv",
        f"  chronoscene bench {scene} --method chronogs --preset fast --budget 3m --max-width 500 "
        f"--out {runs}",
        f"  chronoscene page RUN --out {fake.out}/page",
    ]
    assert "page" not in fake.calls
    assert fake.states["bench"] == "failed"


def arguments_of_trainings(fake, monkeypatch, name):
    """List to which every training, all of which fail, will add one of its arguments."""
    given = []

    def train(scene, method, **options):
        given.append(options[name])
        raise RegistrationError("bench", expected="time", found="none", todo="wait")

    monkeypatch.setattr(steps, "bench", train)
    monkeypatch.setattr(fake, "bench", steps._bench, raising=False)
    return given


def test_the_memory_for_photos_changes_no_step(fake, monkeypatch):
    """The training has it, and no record."""
    asked = arguments_of_trainings(fake, monkeypatch, "photo_memory")
    for memory in (0.5, 1.5):
        call = [str(fake.captures), str(fake.out), "--photo-memory", str(memory)]
        with pytest.raises(RegistrationError):
            CliRunner().invoke(command, call, catch_exceptions=False)
    assert asked == [0.5, 1.5] and fake.calls.count("register") == 1


def test_runs_in_one_folder_share_scene_and_width(fake, monkeypatch):
    folders = arguments_of_trainings(fake, monkeypatch, "out")
    for poses, options in (
        ("first", {"budget": "1m"}),
        ("first", {"budget": "2m"}),
        ("first", {"max_width": 300}),
        ("second", {"max_width": 300}),
    ):
        (fake.photos / "2016/1.jpg").write_text(poses)
        fake.poses = poses
        with pytest.raises(RegistrationError):
            fake.go(**options)
    assert folders[0] == folders[1]
    assert len(set(folders)) == 3


@pytest.mark.parametrize(
    ("options", "error"),
    [({"preset": "unknown"}, ConfigError), ({"budget": "5 minutes"}, ConfigError)],
)
def test_wrong_options_are_refused_before_long_work(fake, options, error):
    with pytest.raises(error):
        fake.go(**options)
    assert not fake.out.exists()


def test_a_folder_with_other_content_is_refused(fake):
    fake.out.mkdir()
    (fake.out / "mine.txt").touch()
    with pytest.raises(SceneError, match="found one that is not empty; choose another folder"):
        fake.go()


def test_nothing_is_written_into_the_photos(fake, monkeypatch):
    monkeypatch.setattr(type(fake), "out", fake.photos / "out")
    with pytest.raises(ConfigError, match="a place outside"):
        fake.go()


@pytest.mark.parametrize("text", ["{", json.dumps({"photos": {}, "options": {}, "more": 1})])
def test_a_damaged_record_is_one_error(fake, text):
    fake.out.mkdir()
    (fake.out / "steps.json").write_text(text)
    with pytest.raises(ChronoSceneError, match=r"steps\.json"):
        fake.go()


def test_a_step_under_way_has_no_result(fake, monkeypatch):
    pages = []
    monkeypatch.setattr(fake, "broken", "page")
    with pytest.raises(RegistrationError):
        fake.go()
    make = fake.page
    monkeypatch.setattr(fake, "page", lambda p: pages.append(fake.html) or make(p), raising=False)
    fake.broken = ""
    fake.go()
    assert "Stopped" not in pages[0]


def test_a_preset_file_counts_by_its_content(fake):
    file = fake.root / "mine.toml"
    for base, calls in (("fast", NAMES), ("fast", ["survey"]), ("balanced", NAMES[2:])):
        file.write_text(f'method = "chronogs"\nbase = "{base}"\n')
        fake.go(preset=str(file))
        assert fake.calls == calls
