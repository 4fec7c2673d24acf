"""A machine that does not see what other machines have: opening it fails in every process here."""

import os
import sys

HIDDEN, SHOWN = os.environ["HIDDEN"], os.environ["SHOWN"]


def hide(event, arguments):
    if event in ("open", "os.listdir", "os.scandir", "os.mkdir") and arguments:
        path = arguments[0]
        if isinstance(path, os.PathLike):
            path = os.fspath(path)
        if isinstance(path, str) and path.startswith(HIDDEN) and not path.startswith(SHOWN):
            raise FileNotFoundError(2, "hidden", path)


sys.addaudithook(hide)
