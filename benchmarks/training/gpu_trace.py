"""Summary of a trace of torch's profiler: how a GPU was used."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

ON_GPU = ("kernel", "gpu_memcpy", "gpu_memset")  # Categories of what occupies it
WAITS = ("cudaDeviceSynchronize", "cudaStreamSynchronize", "cudaEventSynchronize")


class Summary(NamedTuple):
    """Per step."""

    busy_ms: float
    """Time in which it does anything."""
    bytes_to_host: float
    copies_to_host: float
    bytes_from_host: float
    waits: float
    """Calls in which the host waits for it."""


def summary(events: Iterable[Mapping[str, Any]], steps: int) -> Summary:
    """Sums over the ``traceEvents`` of a Chrome trace, divided by the number of steps in it."""
    spans: list[tuple[float, float]] = []
    to_host: list[int] = []
    from_host = waits = 0
    for event in events:
        category, name = event.get("cat"), str(event.get("name"))
        if category in ON_GPU:
            spans.append((event["ts"], event["ts"] + event["dur"]))
        if category == "gpu_memcpy" and "DtoH" in name:
            to_host.append(event["args"]["bytes"])
        if category == "gpu_memcpy" and "HtoD" in name:
            from_host += event["args"]["bytes"]
        waits += name in WAITS
    busy = 1e-3 * _covered(spans)
    return Summary(*(x / steps for x in (busy, sum(to_host), len(to_host), from_host, waits)))


def _covered(spans: list[tuple[float, float]]) -> float:
    """Length of the union of intervals."""
    total, end = 0.0, float("-inf")
    for start, stop in sorted(spans):
        total += max(0.0, stop - max(start, end))
        end = max(end, stop)
    return total
