"""A stand-in for the Hugging Face hub on this machine: the few answers that downloads need."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

COMMIT = "0123456789abcdef0123456789abcdef01234567"
LARGE = 2_000
"""Bytes from which the stand-in stores a file as the hub stores large ones, with its SHA-256."""


class Hub(ThreadingHTTPServer):
    """One dataset, and faults on demand."""

    daemon_threads = True

    def __init__(self, repo: str, files: dict[str, bytes]) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repo, self.files = repo, files
        self.breaks: dict[str, list[int]] = {}
        """Path to the positions at which the connection breaks, each once."""
        self.damaged: set[str] = set()
        """Files that are served with another first byte."""
        self.gated = False
        self.headers: list[Mapping[str, str]] = []
        """Of the requests for files."""
        self.held = threading.Event()
        """Files wait for it in the middle of their contents."""
        self.held.set()
        self.asked: list[tuple[str, str | None]] = []
        """Paths of the files that were asked for, with the range."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def entries(self) -> list[dict]:
        """The files as the hub lists them."""
        listed = []
        for path, content in self.files.items():
            blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
            entry = {"type": "file", "path": path, "size": len(content), "oid": blob}
            if len(content) >= LARGE:
                oid = hashlib.sha256(content).hexdigest()
                entry["oid"] = "0" * 40  # of the pointer, not of the content
                entry["lfs"] = {"oid": oid, "size": len(content), "pointerSize": 130}
            listed.append(entry)
        return [*listed, {"type": "directory", "path": "folder", "oid": "1" * 40}]


class _Handler(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, *arguments: object) -> None:
        """Nothing on the terminal."""

    def do_GET(self) -> None:
        hub, path = self.server, unquote(urlsplit(self.path).path)
        if path == f"/api/datasets/{hub.repo}":
            self._answer(json.dumps({"id": hub.repo, "sha": COMMIT}).encode())
        elif path == f"/api/datasets/{hub.repo}/tree/{COMMIT}":
            self._answer(json.dumps(hub.entries()).encode())
        elif (name := path.removeprefix(f"/datasets/{hub.repo}/resolve/{COMMIT}/")) in hub.files:
            self._answer_file(name)
        else:
            self._refuse(404, "RepoNotFound")

    def _answer(self, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _refuse(self, status: int, code: str) -> None:
        self.send_response(status)
        self.send_header("X-Error-Code", code)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _answer_file(self, name: str) -> None:
        hub, asked = self.server, self.headers.get("Range")
        hub.asked.append((name, asked))
        hub.headers.append(self.headers)
        if hub.gated:
            self._refuse(403, "GatedRepo")
            return
        content = hub.files[name]
        if name in hub.damaged:
            content = bytes([content[0] ^ 1]) + content[1:]
        start = int(asked.removeprefix("bytes=").split("-")[0]) if asked else 0
        self.send_response(206 if asked else 200)
        if asked:
            end = len(content) - 1
            self.send_header("Content-Range", f"bytes {start}-{end}/{len(content)}")
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        waiting = hub.breaks.get(name)
        stop = waiting.pop(0) if waiting else len(content)
        middle = (start + stop) // 2
        self.wfile.write(content[start:middle])
        hub.held.wait()
        self.wfile.write(content[middle:stop])


@contextmanager
def serving(repo: str, files: dict[str, bytes]) -> Iterator[Hub]:
    """The stand-in in a thread of this process."""
    hub = Hub(repo, files)
    thread = threading.Thread(target=hub.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield hub
    finally:
        hub.shutdown()
        thread.join()
        hub.server_close()
