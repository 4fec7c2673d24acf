"""A browser of the viewer without a page: it speaks the protocol of viser over a websocket."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import msgspec
import numpy as np
import zstandard
from websockets.sync.client import connect

TIMEOUT = 20.0


class Browser:
    """Keeps all messages that it gets."""

    def __init__(self, port: int, size: tuple[int, int] = (64, 48)) -> None:
        import viser

        self.size, self.messages, self.buffers = size, [], []
        self.socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        )

    def send(self, kind: str, **fields: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, position: Any, wxyz: Any = (1.0, 0.0, 0.0, 0.0), fov: float = 1.0) -> None:
        """Report a camera, which viser expects before anything else."""
        position = [float(x) for x in position]
        self.send(
            "ViewerCameraMessage",
            wxyz=[float(x) for x in wxyz],
            position=position,
            fov=float(fov),
            near=0.01,
            far=1000.0,
            image_width=self.size[0],
            image_height=self.size[1],
            look_at=[position[0], position[1], position[2] + 1.0],
            up_direction=[0.0, -1.0, 0.0],
        )

    def receive(self, timeout: float = TIMEOUT) -> None:
        """Wait for some more messages."""
        data = self.socket.recv(timeout)
        length = int.from_bytes(data[8:16], "little")
        packed = zstandard.ZstdDecompressor().decompress(
            data[16 : 16 + length], max_output_size=int.from_bytes(data[:8], "little")
        )
        self.messages += msgspec.msgpack.decode(packed)["messages"]

    def wait(self, found: Callable[[], Any], timeout: float = TIMEOUT) -> Any:
        """Receive until a function returns something true, and return that."""
        end = time.monotonic() + timeout
        while not (value := found()):
            self.receive(max(0.01, end - time.monotonic()))
        return value

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [message for message in self.messages if message["type"] == kind]

    def control(self, label: str) -> str:
        """Identifier of a control of the panel."""
        return self.wait(
            lambda: [
                message["uuid"]
                for message in self.messages
                if message.get("props", {}).get("label") == label
            ]
        )[0]

    def set(self, label: str, value: Any) -> None:
        self.send("GuiUpdateMessage", uuid=self.control(label), updates={"value": value})

    def pictures(self) -> list[np.ndarray]:
        """Complete pictures so far. [H, W, 3]"""
        found = [m["rgb_data"] for m in self.of("BackgroundImageMessage") if m["rgb_data"]]
        images = [cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1] for data in found]
        return [image.astype(int) for image in images if image.shape[1::-1] == self.size]

    def picture(self, accept: Callable[[np.ndarray], Any] = lambda image: True) -> np.ndarray:
        """Wait for a new complete picture that is accepted. [H, W, 3]"""
        self.messages = [m for m in self.messages if m["type"] != "BackgroundImageMessage"]
        return self.wait(lambda: [image for image in self.pictures() if accept(image)])[-1]

    def drop(self) -> None:
        """Break the connection without a farewell."""
        self.socket.socket.shutdown(2)
        self.socket.socket.close()
