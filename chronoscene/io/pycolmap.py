"""pycolmap, loaded such that signals keep their meaning. The only module that imports it.

pycolmap installs handlers of its own when it is loaded. The one for SIGTERM prints a C++ stack
trace and ends the process at once, so ours, which clean up, would never run.
"""

import signal
import threading

_TERM = {signal.SIGTERM}

if hasattr(signal, "pthread_sigmask") and threading.current_thread() is threading.main_thread():
    _handler = signal.getsignal(signal.SIGTERM)
    # A signal that comes while pycolmap loads (about 0.3 s) waits for the right handler.
    _mask = signal.pthread_sigmask(signal.SIG_BLOCK, _TERM)
    try:
        import pycolmap
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if _handler is None else _handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, _mask)
else:  # not on Windows; and handlers can be set by the main thread alone
    import pycolmap

__all__ = ["pycolmap"]
