"""All rules, by the groups of their codes: ``cs1_cameras`` has rules CS1xx, those on cameras."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches

from chronoscene.errors import ConfigError
from chronoscene.validation.rule import GROUPS, RULES, Rule
from chronoscene.validation.rules import (  # noqa: F401  (importing them registers the rules)
    cs0_folder,
    cs1_cameras,
    cs1_model,
    cs1_poses,
    cs2_image_files,
    cs2_metadata,
    cs2_other_photo,
    cs3_split,
    cs4_periods,
    cs5_across_periods,
    cs5_points,
    cs5_reprojection,
    cs6_leaks,
    cs7_released_code,
)

NEAR = 0.8  # Likeness of a name from which it may be meant


def all_rules() -> tuple[Rule, ...]:
    """Every rule, sorted by code."""
    return tuple(RULES[code] for code in sorted(RULES))


def choose_rules(
    select: Iterable[str] = (), ignore: Iterable[str] = (), *, place: str = "--select"
) -> tuple[Rule, ...]:
    """Rules to run.

    Args:
        select: Codes, prefixes of codes (``CS2``) or names; empty selects all.
        ignore: The same, removed from the selection.
        place: Option that ``select`` comes from, for errors.

    Raises:
        ConfigError: If one matches no rule.
    """
    rules = all_rules()
    wanted = [_matching(place, text, rules) for text in select] or [{r.code for r in rules}]
    unwanted = [_matching("--ignore", text, rules) for text in ignore]
    codes = set().union(*wanted).difference(*unwanted)
    return tuple(r for r in rules if r.code in codes)


def _matching(place: str, text: str, rules: tuple[Rule, ...]) -> set[str]:
    key = text.strip()
    codes = {r.code for r in rules if r.name == key.lower()}
    if re.fullmatch("CS[0-9]{0,3}", key.upper()):
        codes |= {r.code for r in rules if r.code.startswith(key.upper())}
    if codes:
        return codes
    family = [r.code for r in rules if r.code.startswith(key[:3].upper())]  # or none, such as CS9
    close = get_close_matches(key.upper(), family, n=1)
    close = close or get_close_matches(key.lower(), [r.name for r in rules], n=1, cutoff=NEAR)
    families = ", ".join(f"{prefix} ({about})" for prefix, about in GROUPS.items())
    raise ConfigError(
        place,
        expected="rule codes, prefixes of codes or rule names",
        found=repr(text),
        todo=f"did you mean {close[0]}?" if close else f"choose from {families}",
    )
