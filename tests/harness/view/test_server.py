"""The live viewer as browsers see it, and its command."""

import io
import json
import re
import signal
import socket
import subprocess
import sys
import warnings
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from fresh_process import run_python
from PIL import Image
from waiting import wait_for

from chronoscene.cli import cli
from chronoscene.errors import ChronoSceneError, ConfigError
from chronoscene.figures.canvas import period_colors
from chronoscene.formats import read_scene
from chronoscene.harness.use.cameras import find_viewpoints
from chronoscene.harness.use.trained_run import open_run
from chronoscene.harness.view import server as server_module
from chronoscene.harness.view.content import Content
from chronoscene.harness.view.panel import POINTS
from chronoscene.harness.view.server import PORT, ViewServer, choose_port, tunnel_command
from chronoscene.harness.view.summary import certificate_summary
from chronoscene.methods import Prediction
from chronoscene.scene import Period

pytest.importorskip("viser", reason="viser is not installed")
from benchmarks.viewer.browser import Browser


@pytest.fixture
def serve():
    """Factory of servers on free ports."""
    with ExitStack() as stack:

        def start(content):
            server = ViewServer(content, "127.0.0.1", choose_port("127.0.0.1", None))
            stack.callback(server.stop)
            return server

        yield start


def content_of(*folders):
    runs = [open_run(folder) for folder in folders]
    return Content(runs[0].scene(), runs)


def enter(server):
    """A browser at the start of the scene."""
    browser = Browser(server.port)
    browser.look(server._content.start()[0])
    return browser


def equals(image):
    return lambda other: np.abs(other - image).max() == 0


def differs(image):
    return lambda other: np.abs(other - image).mean() > 1


def joins(left, right):
    """Accept a picture with these halves; the rows beside the line are blurred by JPEG."""
    return lambda other: (
        np.abs(other - left)[:, :24].mean() < 2 and np.abs(other - right)[:, 40:].mean() < 2
    )


def test_each_browser_has_a_state_of_its_own(trained, serve):
    server = serve(content_of(trained["3dgs-period"]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first, second = enter(server), enter(server)
        start = first.picture()
        second.picture(equals(start))
        first.set("Period", 1.0)
        first.picture(differs(start))
        second.look(server._content.start()[0])  # asks again
        second.picture(equals(start))
        wait_for(lambda: len(server.viewers) == 2)
        second.drop()
        wait_for(lambda: len(server.viewers) == 1)
        wait_for(lambda: len(server._worker._seats) == 1)
        first.set("Period", 0.0)
        first.picture(equals(start))


def test_split_depth_and_colours_of_another_period(trained, serve):
    server = serve(content_of(trained["3dgs-period"]))
    browser = enter(server)
    left = browser.picture()
    browser.set("Period", 1.0)
    right = browser.picture(differs(left))
    browser.set("Period", 0.0)
    browser.picture(equals(left))
    browser.set("Split", True)
    browser.picture(joins(left, right))
    browser.set("Position", 1.0)
    browser.picture(equals(left))
    browser.set("Split", False)
    browser.set("Colours of", 1.0)
    browser.set("Colours of another period", True)
    browser.picture(lambda image: np.abs(image - right).mean() < 1)  # periods differ in exposure
    browser.set("Depth", True)
    browser.picture(lambda image: differs(left)(image) and differs(right)(image))


def test_two_methods_side_by_side(trained, serve):
    server = serve(content_of(trained["chronogs"], trained["3dgs-period"]))
    browser = enter(server)
    names = ["1: ChronoGS, joint", "2: 3DGS, period exposure, joint"]
    both = browser.picture()
    dropdown = next(
        m for m in browser.messages if m.get("props", {}).get("label") == "Right method"
    )
    assert list(dropdown["props"]["options"]) == names and dropdown["value"] == names[1]
    browser.set("Split", False)
    left = browser.picture(differs(both))
    browser.set("Method", names[1])
    right = browser.picture(differs(left))
    assert joins(left, right)(both)


def test_cameras_points_and_a_visit(trained, serve):
    server = serve(content_of(trained["chronogs"]))
    browser = enter(server)
    browser.picture()
    browser.set("Cameras", True)
    browser.wait(lambda: len(browser.of("CameraFrustumMessage")) == 4)
    assert {m["name"] for m in browser.of("CameraFrustumMessage")} == {
        f"/cameras/{number}" for number in (1, 2, 3, 4)
    }
    browser.set("Sparse points", POINTS[2])
    cloud = browser.wait(lambda: browser.of("PointCloudMessage"))[0]
    assert cloud["name"] == "/points/-1"
    assert browser.wait(
        lambda: [m for m in browser.of("BackgroundImageMessage") if m["depth_data"]]
    )
    (viewer,) = server.viewers.values()
    frame = server._content.scene.frames[5]
    viewer._visit(frame)
    browser.wait(lambda: browser.of("SetCameraPositionMessage"))
    assert np.allclose(viewer._now().pose, frame.cam_from_world, atol=1e-6)
    assert viewer._now().period == frame.period == 1
    browser.wait(lambda: len({m["name"] for m in browser.of("CameraFrustumMessage")}) == 8)
    assert browser.wait(lambda: browser.of("GuiImageMessage"))[0]["props"]["label"] == frame.name


def test_changes_are_drawn_once_for_all(trained, serve, monkeypatch):
    server = serve(content_of(trained["chronogs"]))
    first, second = enter(server), enter(server)
    first.set("Show changes", True)
    cloud = first.wait(lambda: first.of("PointCloudMessage"))[0]
    assert cloud["name"] == "/changes"
    monkeypatch.setattr("chronoscene.harness.view.content.map_pair", None)
    second.set("Show changes", True)
    assert second.wait(lambda: second.of("PointCloudMessage"))


def test_a_saved_path_is_one_of_render(trained, serve, tmp_path):
    server = serve(content_of(trained["chronogs"]))
    browser = enter(server)
    (viewer,) = browser.wait(lambda: list(server.viewers.values()))
    view = viewer._now()
    for period in (0.0, 1.0):
        browser.set("Period", period)
        wait_for(lambda period=period: viewer._now().period == period)
        viewer._keep([*viewer._views, viewer._now()])
    browser.set("Seconds", 1.0)
    wait_for(lambda: viewer._seconds.value == 1.0)
    viewer._send_path()
    part = browser.wait(lambda: browser.of("FileTransferPart"))[0]
    (tmp_path / "path.json").write_bytes(part["content"])
    run = open_run(trained["chronogs"])
    found = find_viewpoints(str(tmp_path / "path.json"), run, None, 1).viewpoints
    assert [found[0].period, found[-1].period] == [0, 1]
    assert np.allclose(found[0].cam_from_world, view.pose, atol=1e-9)


def test_an_error_is_shown_and_the_viewer_goes_on(trained, serve, monkeypatch):
    server = serve(content_of(trained["chronogs"]))
    browser = enter(server)
    before = browser.picture()
    run = server._content.runs[0]
    render = type(run).render
    broken = ConfigError("period 1", expected="a model", found="none", todo="copy it")

    def refuse(self, camera, pose, period, **options):
        if period == 1:
            raise broken
        return render(self, camera, pose, period, **options)

    monkeypatch.setattr(type(run), "render", refuse)
    browser.set("Period", 1.0)
    note = browser.wait(
        lambda: browser.of("NotificationShowMessage") or browser.of("NotificationMessage")
    )
    assert str(broken) in str(note)
    browser.set("Period", 0.0)
    assert np.abs(browser.picture() - before).max() == 0


class Grey:
    """A run that shows one colour at one depth."""

    spec = SimpleNamespace(title="Grey", outputs=("rgb", "depth"))
    record = SimpleNamespace(strategy="joint")
    separates_appearance = distinguishes_periods = is_continuous = False

    def render(self, camera, pose, period, **options):
        depth = np.ones((camera.height, camera.width), np.float32)
        return Prediction(rgb=np.repeat(depth[..., None] / 2, 3, axis=2), depth=depth)


def test_a_canvas_that_no_picture_fills_stops_no_other_viewer(scene_folder, serve):
    server = serve(Content(read_scene(scene_folder), [Grey()]))
    Browser(server.port, (70_000, 2)).look((0, 0, 0))  # JPEG has 65,535 pixels at most
    wait_for(lambda: server._worker._seats)
    (wide,) = server._worker._seats.values()
    wait_for(lambda: wide.drawn == wide.full)
    enter(server).picture()


def test_a_scene_has_points_and_cameras(scene_folder, serve):
    server = serve(Content(read_scene(scene_folder), summary="**Alignment: pass.**"))
    browser = enter(server)
    browser.wait(lambda: len(browser.of("CameraFrustumMessage")) == 4)
    assert browser.of("PointCloudMessage")[0]["name"] == "/points/-1"
    (legend,) = browser.of("GuiHtmlMessage")
    for color, label in zip(period_colors(2), server._content.cloud.labels, strict=True):
        assert re.search(f"{color}[^>]*>[^>]*> {label}<", legend["props"]["content"])
    browser.set("Sparse points", POINTS[1])

    def hidden():
        updates = [m for m in browser.of("GuiUpdateMessage") if m["uuid"] == legend["uuid"]]
        return updates and updates[-1]["updates"] == {"visible": False}

    browser.wait(hidden)

    def photos():
        updates = browser.of("SceneNodeUpdateMessage")
        return {m["name"] for m in updates if "_image_data" in m["updates"]}

    browser.wait(lambda: photos() == {f"/cameras/{number}" for number in (1, 2, 3, 4)})
    assert "pass" in str(browser.of("GuiMarkdownMessage")[0])
    assert not browser.pictures()


def test_in_chromium(trained, serve, browser_with_webgl):
    server = serve(content_of(trained["3dgs-period"]))
    page = browser_with_webgl.new_page(viewport={"width": 640, "height": 300})
    page.set_default_timeout(30000)
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"http://127.0.0.1:{server.port}")
    wait_for(lambda: server.viewers)
    (viewer,) = server.viewers.values()

    def shown():
        corner = {"x": 0, "y": 200, "width": 200, "height": 100}
        return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=corner)))).astype(int)

    wait_for(lambda: np.ptp(shown()) > 20)
    before, pose = shown(), viewer._now().pose
    period = page.get_by_text("Period", exact=True).locator("xpath=ancestor::*[.//input][1]//input")
    period.last.fill("1")
    period.last.press("Enter")
    wait_for(lambda: np.abs(shown() - before).mean() > 2)
    page.mouse.move(100, 250)
    page.mouse.down()
    page.mouse.move(180, 250, steps=4)
    page.mouse.up()
    wait_for(lambda: np.abs(viewer._now().pose - pose).max() > 0.01)
    page.close()
    wait_for(lambda: not server.viewers)
    assert not problems


@pytest.fixture
def occupied():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield taken.getsockname()[1]


def test_ports(occupied, monkeypatch):
    with pytest.raises(ConfigError, match=f"127.0.0.1:{occupied}: expected a free port .*--port"):
        choose_port("127.0.0.1", occupied)
    monkeypatch.setattr(server_module, "PORT", occupied)
    assert choose_port("127.0.0.1", None) > occupied
    monkeypatch.setattr(server_module, "TRIES", 1)
    with pytest.raises(ConfigError, match="in use"):
        choose_port("127.0.0.1", None)


@pytest.mark.parametrize("host", ["192.0.2.1", "nowhere.invalid", "2001:db8::1"])
def test_hosts_of_others(host):
    with pytest.raises(ConfigError, match="address of this machine"):
        choose_port(host, None)


def test_the_tunnel(monkeypatch):
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.2 51000 10.0.0.7 22")
    monkeypatch.setenv("USER", "ada")
    assert tunnel_command("127.0.0.1", 8081) == "ssh -N -L 8081:127.0.0.1:8081 ada@10.0.0.7"
    assert tunnel_command("0.0.0.0", 8081) == "ssh -N -L 8081:localhost:8081 ada@10.0.0.7"
    monkeypatch.delenv("SSH_CONNECTION")
    assert tunnel_command("127.0.0.1", 8081) is None


def test_without_viser(trained, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    result = CliRunner().invoke(cli, ["view", str(trained["chronogs"])])
    assert isinstance(result.exception, ConfigError)
    assert "pip install 'chronoscene[view]'" in str(result.exception)


def test_options_without_effect_are_refused(trained, scene_folder):
    for arguments, message in (
        ((trained["chronogs"], "--period-by", "year"), "--period-by: expected no such option with"),
        ((scene_folder, "--device", "cpu"), "--device: expected no such option without a run"),
        ((scene_folder, "--scene", scene_folder), "--scene: expected no such option without a run"),
    ):
        result = CliRunner().invoke(cli, ["view", *map(str, arguments)])
        assert message in str(result.exception)


def test_several_scenes_are_refused(scene_folder):
    result = CliRunner().invoke(cli, ["view", str(scene_folder), str(scene_folder)])
    assert "expected one scene, or runs only" in str(result.exception)


def test_the_command_ends_at_an_interruption_and_needs_no_torch(scene_folder):
    code = (
        # A shell lets what it starts in the background ignore interruptions.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import sys; from chronoscene.cli import main\n"
        "try: main()\n"
        "finally: print('torch' in sys.modules)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "view", str(scene_folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    line = process.stdout.readline()
    port = int(re.search(r"http://127.0.0.1:(\d+)", line)[1])
    assert port >= PORT
    browser = Browser(port)
    browser.look((0, 0, 0))
    browser.wait(lambda: browser.of("PointCloudMessage"))
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0
    assert out == "False\n"
    assert "Traceback" not in err and "viser" not in err


def test_the_command_leaves_in_the_middle_of_a_picture(scene_folder):
    """A thread that the interpreter ends in C++, as of torch, aborts the process."""
    code = """
import atexit, sys
from chronoscene.cli import main
from chronoscene.cli.runs import view
class Server:
    port = 1
    def __init__(self, *arguments): pass
    def stop(self): return False
def interrupt(*arguments):
    raise KeyboardInterrupt
view.ViewServer, view._report = Server, interrupt
atexit.register(print, "the interpreter has ended the threads")
sys.argv[1:] = ["view", sys.argv[1]]
main()
"""
    assert run_python(code, scene_folder) == ""


CERTIFICATE = {
    "alignment": {"verdict": "pass", "text": "Both periods fit."},
    "absolute_position": {"verdict": "not checked", "text": "Nothing to compare with."},
    "periods": [{"period": 0, "label": "1996"}, {"period": 1, "label": "2004"}],
    "pairs": [
        {
            "periods": [0, 1],
            "verdict": "pass",
            "figures": [
                {"name": "tie points of the model", "value": 5, "unit": "", "over": ""},
                {
                    "name": "held-out reprojection error, median",
                    "value": 0.61,
                    "unit": "px",
                    "over": "400 observations",
                },
            ],
        }
    ],
}


def test_a_certificate_in_short(tmp_path):
    labels = ["1996", "2004"]
    assert certificate_summary(tmp_path, labels) == ""
    (tmp_path / "registration.json").write_text(json.dumps(CERTIFICATE))
    verdicts = [
        r"**Alignment: pass\.** Both periods fit\.",
        r"**Absolute position: not checked\.** Nothing to compare with\.",
    ]
    assert certificate_summary(tmp_path, labels).split("\n\n") == [
        *verdicts, "**1996 and 2004: pass**", r"held\-out reprojection error\, median\: 0\.61 px",
    ]  # fmt: skip
    assert certificate_summary(tmp_path, ["2004"]).split("\n\n") == verdicts


def test_names_of_strangers_are_text(scene_folder, serve, tmp_path):
    mark = "<script>x</script>![x](http://a.invalid/b)"
    shown = r"\<script\>x\<\/script\>\!\[x\]\(http\:\/\/a\.invalid\/b\)"
    alignment = {"verdict": mark, "text": f"a\n\n{mark}"}
    (tmp_path / "registration.json").write_text(json.dumps(CERTIFICATE | {"alignment": alignment}))
    summary = certificate_summary(tmp_path, ())
    assert summary.startswith(rf"**Alignment: {shown}\.** a {shown}")
    scene = read_scene(scene_folder)
    scene = replace(scene, periods=(Period(0, mark), Period(1, mark)))
    browser = enter(serve(Content(scene)))
    update = {"_markdown": rf"**0\: {shown}**"}
    browser.wait(lambda: update in [m["updates"] for m in browser.of("GuiUpdateMessage")])


@pytest.mark.parametrize("change", [{"pairs": [{}]}, {"alignment": None}, {"pairs": [3]}])
def test_a_damaged_certificate(tmp_path, change):
    (tmp_path / "registration.json").write_text(json.dumps(CERTIFICATE | change))
    with pytest.raises(ChronoSceneError, match=r"registration\.json: .*register again"):
        certificate_summary(tmp_path, ())
