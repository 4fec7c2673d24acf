"""Rules that every method keeps, so that the harness can drive it like any other.

`CHECKS` has a function for each rule; ``chronoscene check-method`` and the tests of the methods of
ChronoScene call all of them. Methods are trained on painted balls, on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from chronoscene.errors import ChronoSceneError
from chronoscene.harness.contract import description, extension, rendering, storage, training
from chronoscene.harness.contract.subject import NotApplicableError, Subject, demand

Check = Callable[[Subject], None]
"""Raise an error if a method breaks the rule, the first sentence of the docstring."""

CHECKS: tuple[Check, ...] = (
    *description.CHECKS,
    *training.CHECKS,
    *storage.CHECKS,
    *rendering.CHECKS,
    *extension.CHECKS,
)


@dataclass(frozen=True, slots=True)
class RuleResult:
    """Result of a check."""

    rule: str
    problem: str | None = None
    """Reason why the method fails; None if it passes, or was not checked."""
    left_out: str | None = None
    """Reason why the rule does not apply to the method."""


def check_method(name: str, checks: Sequence[Check] = CHECKS) -> Iterator[RuleResult]:
    """Check a method; yield the verdicts one by one.

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
                yield RuleResult(rule)
            except NotApplicableError as reason:
                yield RuleResult(rule, left_out=str(reason))
            except ChronoSceneError as error:
                yield RuleResult(rule, str(error))
            except Exception as error:  # of the method; the other rules may still say something
                yield RuleResult(rule, f"{type(error).__name__}: {error}")
