"""All rules, one module for each group. A new module is added to the imports below."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches

from chronoscene.errors import ConfigError
from chronoscene.validation.rule import GROUPS, RULES, Rule
from chronoscene.validation.rules import (  # noqa: F401  (importing them registers the rules)
    conventions,
    dates,
    duplicates,
    folder,
    foreign_folder,
    image_files,
    image_kinds,
    intrinsics,
    model_files,
    names,
    official,
    outliers,
    periods,
    photo_contents,
    photo_metadata,
    points,
    poses,
    reprojection_errors,
    rigs,
    split_file,
    test_list,
    world_frames,
)


def all_rules() -> tuple[Rule, ...]:
    """Every rule, sorted by code."""
    return tuple(RULES[code] for code in sorted(RULES))


def choose_rules(
    select: Iterable[str] = (), ignore: Iterable[str] = (), *, place: str = "--select"
) -> tuple[Rule, ...]:
    """Rules to run.

    Args:
        select: Codes, beginnings of codes (``CS2``) or names; nothing selects all.
        ignore: The same, taken away afterwards.
        place: Option that ``select`` comes from, for errors.

    Raises:
        ConfigError: If one fits no rule.
    """
    rules = all_rules()
    wanted = [_matching(place, text, rules) for text in select]
    unwanted = [_matching("--ignore", text, rules) for text in ignore]
    codes = set().union(*wanted) if wanted else {r.code for r in rules}
    codes -= set().union(*unwanted)
    return tuple(r for r in rules if r.code in codes)


def _matching(place: str, text: str, rules: tuple[Rule, ...]) -> set[str]:
    """Codes of the rules that a user means."""
    key = text.strip()
    codes = {r.code for r in rules if r.name == key.lower()}
    if re.fullmatch("CS[0-9]{0,3}", key.upper()):
        codes |= {r.code for r in rules if r.code.startswith(key.upper())}
    if codes:
        return codes
    known = [r.code for r in rules] + [r.name for r in rules]
    close = get_close_matches(key, known, n=1)
    raise ConfigError(
        place,
        expected=f"codes of rules, beginnings of codes ({', '.join(GROUPS)}) or names",
        found=repr(text),
        todo=f"did you mean {close[0]}?" if close else "DATASET.md lists the rules",
    )
