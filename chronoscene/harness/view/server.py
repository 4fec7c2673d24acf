"""The server of the live viewer: its port, and the browsers that come and go."""

from __future__ import annotations

import errno
import io
import os
import socket
import threading
import warnings
from contextlib import redirect_stdout
from typing import TYPE_CHECKING

from chronoscene.checks import import_extra
from chronoscene.errors import ConfigError
from chronoscene.harness.view.content import Content
from chronoscene.harness.view.panel import Viewer
from chronoscene.harness.view.worker import RenderWorker

if TYPE_CHECKING:
    import viser

PORT, TRIES = 8080, 100
"""First port that is tried, and number of ports."""
ANYWHERE = {"0.0.0.0": "localhost", "::": "localhost"}
"""Names by which this machine reaches a server that listens on all of its addresses."""


def choose_port(host: str, port: int | None) -> int:
    """Return a port that is free: the one asked for, else the first from `PORT` on.

    Raises:
        ConfigError: If there is none, or the host is not one of this machine.
    """
    for number in range(PORT, PORT + TRIES) if port is None else (port,):
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            socket.create_server((host, number), family=family).close()
        except OSError as error:
            place, found = f"{host}:{number}", str(error.strerror).partition(" (")[0]
            if error.errno != errno.EADDRINUSE:
                break
        else:
            return number
    raise ConfigError(
        place,
        expected="a free port at an address of this machine",
        found=found,
        todo="choose another one with --port or --host",
    )


def tunnel_command(host: str, port: int) -> str | None:
    """Return the command for the user's own machine if this one is used through SSH."""
    connection = os.environ.get("SSH_CONNECTION", "").split()
    if len(connection) != 4:
        return None
    user = f"{os.environ['USER']}@" if "USER" in os.environ else ""
    return f"ssh -N -L {port}:{ANYWHERE.get(host, host)}:{port} {user}{connection[2]}"


class ViewServer:
    """Serves a content to any number of browsers, each with a camera and a panel of its own."""

    def __init__(self, content: Content, host: str, port: int) -> None:
        """Begin to serve at a port from `choose_port`.

        Raises:
            ConfigError: If viser is missing.
        """
        viser = import_extra("viser", "view", "chronoscene view")
        self.viewers: dict[int, Viewer] = {}
        """Browsers that are connected, by their number."""
        self._content = content
        self._worker = RenderWorker() if content.runs else None
        self._lock = threading.Lock()
        # A browser can leave between the last look at it and a message.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        with redirect_stdout(io.StringIO()):  # what viser prints
            self._server = viser.ViserServer(host, port, label=content.cloud.name, verbose=False)
        self.port = self._server.get_port()
        """Another one than asked for if that was taken in the meantime."""
        # Any browser can ask viser for a public address, through a machine of others.
        self._server.request_share_url = lambda verbose=True: None
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        camera = self._server.initial_camera
        camera.position, camera.look_at, up = content.start()
        self._server.scene.set_up_direction(up)
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)

    def stop(self) -> bool:
        """Disconnect all browsers and stop to serve; False if a picture is still being drawn."""
        for viewer in [*self.viewers.values()]:
            viewer.close()
        has_ended = self._worker is None or self._worker.stop()
        with redirect_stdout(io.StringIO()):
            self._server.stop()
        return has_ended

    def _enter(self, client: viser.ClientHandle) -> None:
        viewer = Viewer(client, self._content, self._worker)
        with self._lock:
            self.viewers[client.client_id] = viewer
        if client.client_id not in self._server.get_clients():  # has left already
            self._leave(client)
        viewer.update()

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            viewer = self.viewers.pop(client.client_id, None)
        if viewer is not None:
            viewer.close()
