"""Pictures a second that a browser gets from the live viewer while its camera moves.

    python -m benchmarks.viewer.updates RUN [--seconds 15] [--width 1280] [--height 720]

The browser is a process without a page. It moves on an orbit of 10 seconds around the scene, sends
60 cameras a second as Chromium does, and counts the pictures that arrive, after three seconds in
which the resolution adapts. Then pictures of that size are drawn along the orbit by themselves.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from benchmarks.viewer.browser import Browser
from chronoscene.arrays import Array
from chronoscene.harness.use.trained_run import open_run
from chronoscene.harness.view.content import Content
from chronoscene.harness.view.paths import KeyView
from chronoscene.harness.view.pictures import Side, draw_picture
from chronoscene.harness.view.server import ViewServer, choose_port
from chronoscene.scene.geometry import camera_centre, quaternion_from_rotation
from chronoscene.scene.orbit import orbit

CAMERAS_A_SECOND, ORBIT_SECONDS, WARM_UP = 60, 10, 3
FOV = np.deg2rad(75.0)  # Of viser's first view

Size = tuple[int, int]


def main() -> None:
    """Measure one run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    for name, default in (("seconds", 15), ("width", 1280), ("height", 720)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    run, size = open_run(options.run), (options.width, options.height)
    content = Content(run.scene(), [run])
    points = content.view_from_world.apply(content.cloud.xyz)
    path = orbit(content.poses, points, CAMERAS_A_SECOND * ORBIT_SECONDS)
    draw_alone(content, path, size, 320 * 240)  # opens the model, compiles the kernels
    server = ViewServer(content, "127.0.0.1", choose_port("127.0.0.1", None))
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as browser:
            gaps, shown = browser.submit(move, server.port, path, size, options.seconds).result()
    finally:
        server.stop()
    print(
        f"{1 / gaps.mean():.1f} pictures a second of {shown[0]} x {shown[1]}, median interval "
        f"{1000 * np.median(gaps):.0f} ms, 95 % within {1000 * np.percentile(gaps, 95):.0f} ms"
    )
    for pixels in (shown[0] * shown[1], size[0] * size[1]):
        times = draw_alone(content, path, size, pixels)
        print(f"drawn alone, {pixels:,} pixels: median {1000 * np.median(times):.0f} ms")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")


def move(port: int, path: Array, size: Size, seconds: int) -> tuple[Array, Size]:
    """Move a browser; return the seconds between its pictures, and their median size."""
    browser, ended = Browser(port, size), threading.Event()

    def send() -> None:
        for i in range((WARM_UP + seconds) * CAMERAS_A_SECOND):
            pose = path[i % len(path)]
            browser.look(camera_centre(pose), quaternion_from_rotation(pose[:3, :3].T), FOV)
            time.sleep(1 / CAMERAS_A_SECOND)
        ended.set()

    threading.Thread(target=send, daemon=True).start()
    begin, times, sizes = time.monotonic() + WARM_UP, [], []
    while not ended.is_set():
        browser.messages.clear()
        browser.receive()
        for data in (message["rgb_data"] for message in browser.of("BackgroundImageMessage")):
            if data and time.monotonic() > begin:
                times.append(time.monotonic())
                sizes.append(cv2.imdecode(np.frombuffer(data, np.uint8), 1).shape[1::-1])
    return np.diff(times), sorted(sizes)[len(sizes) // 2]


def draw_alone(content: Content, path: Array, size: Size, pixels: int) -> list[float]:
    """Return the seconds of 30 pictures along the path."""
    times = []
    for pose in path[:: len(path) // 30]:
        view = KeyView(content.view_from_world.inverse().apply_to_pose(pose), FOV, 0.0)
        started = time.perf_counter()
        draw_picture(view, size, [Side(content.runs[0], 0.0)], pixels)
        times.append(time.perf_counter() - started)
    return times


if __name__ == "__main__":
    main()
