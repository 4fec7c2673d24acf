"""What every method must do, so that the harness need not know which one it drives.

`CHECKS` has one function for each rule; ``chronoscene check-method`` calls all of them, and so do
our tests for the methods that come with ChronoScene. Methods are trained on painted balls,
`chronoscene.bench.contract.tiny_training`, on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from chronoscene.bench.contract import description, extension, rendering, storage, training
from chronoscene.bench.contract.subject import NotApplicableError, Subject, demand
from chronoscene.errors import ChronoSceneError

Check = Callable[[Subject], None]
"""The first sentence of its docstring is the rule. Raises an error if the method breaks it."""

CHECKS: tuple[Check, ...] = (
    *description.CHECKS,
    *training.CHECKS,
    *storage.CHECKS,
    *rendering.CHECKS,
    *extension.CHECKS,
)


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found."""

    rule: str
    problem: str | None = None
    """Why the method fails; None if it passes, or was not checked."""
    left_out: str | None = None
    """Why the rule says nothing of the method."""


def check_method(name: str, checks: Sequence[Check] = CHECKS) -> Iterator[Finding]:
    """Check a method; yields what each check found, as soon as it is known.

    Raises:
        ConfigError: If there is no such method.
        MethodError: If it is another program, which has no class to check.
    """
    with TemporaryDirectory() as folder:
        subject = Subject(name, Path(folder))
        demand(subject.spec.runner is None, name, "a method with a class", "another program")
        for function in checks:
            rule, *_ = (function.__doc__ or "").split(".\n")
            rule = " ".join(rule.split()).rstrip(".")
            try:
                function(subject)
                yield Finding(rule)
            except NotApplicableError as reason:
                yield Finding(rule, left_out=str(reason))
            except ChronoSceneError as error:
                yield Finding(rule, str(error))
            except Exception as error:  # of the method; the other rules may still say something
                yield Finding(rule, f"{type(error).__name__}: {error}")
