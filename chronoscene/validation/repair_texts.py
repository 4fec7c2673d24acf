"""``split.txt`` and ``test.txt`` written again: full names, single blanks, ids from 0 on.

Lines that contradict each other, fit several images or are no lines at all stay: what they mean is
for people to say.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from chronoscene.splits import NameEntry, NameIndex, SplitEntry
from chronoscene.validation.finding import counted
from chronoscene.validation.repair_model import Repair


def repair_split(
    data: bytes, text: str, names: Sequence[str], entries: Sequence[SplitEntry]
) -> tuple[str, dict[int, int], list[Repair]]:
    """A better ``split.txt``.

    Args:
        data: The file.
        text: The same, decoded.
        names: Full names of the registered images.
        entries: Its readable lines.

    Returns:
        The new text; new ids by the old ones; what was done.
    """
    repairs = _line_repairs(data, text)
    ids = sorted({entry.period for entry in entries})
    new_ids = {old: new for new, old in enumerate(ids)}
    if ids != list(range(len(ids))):
        listed = ", ".join(f"{old} is now {new}" for old, new in list(new_ids.items())[:10])
        repairs.append(Repair("CS401", f"periods numbered from 0: {listed}"))
    lines, unknown, twice = _split_lines(text, names, entries, new_ids)
    if unknown:
        gone = counted(unknown, "line")
        repairs.append(Repair("CS309", f"{gone} on images that are not in the model removed"))
    if twice:
        repairs.append(Repair("CS308", f"{counted(twice, 'repeated line')} removed"))
    return "".join(f"{line}\n" for line in lines if line), new_ids, repairs


def _split_lines(
    text: str, names: Sequence[str], entries: Sequence[SplitEntry], new_ids: Mapping[int, int]
) -> tuple[list[str], int, int]:
    """New lines, and how many old ones are left out: of unknown images, and repeated ones."""
    index = NameIndex(names)
    by_line = {entry.line: (entry, index.find(entry.name)) for entry in entries}
    used = {entry.period for entry, fits in by_line.values() if len(fits) == 1}
    lines: list[str] = []
    unknown = twice = 0
    done: set[tuple[str, int]] = set()
    for number, line in enumerate(re.split("\r\n|\r|\n", text), start=1):
        if number not in by_line:
            lines.append(" ".join(line.split()))
            continue
        entry, fits = by_line[number]
        name = _one_name(fits, entry.name)
        if not fits and entry.period in used:
            unknown += 1
        elif (name, entry.period) in done:
            twice += 1
        else:
            done.add((name, entry.period))
            lines.append(f"{name} {new_ids[entry.period]}")
    return lines, unknown, twice


def _line_repairs(data: bytes, text: str) -> list[Repair]:
    repairs = []
    if data[:3] == b"\xef\xbb\xbf" or data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        repairs.append(Repair("CS701", "saved as UTF-8 without a byte order mark"))
    if "\r" in text:
        repairs.append(Repair("CS310", "Unix line ends"))
    lines = re.split("\r\n|\r|\n", text)
    odd = sum(line != " ".join(line.split()) for line in lines)
    odd += sum(not line.strip() for line in lines[:-1])
    if odd:
        repairs.append(Repair("CS701", f"blanks, tabs and empty lines of {counted(odd, 'line')}"))
    return repairs


def repair_test(
    names: Sequence[str], entries: Sequence[NameEntry]
) -> tuple[list[str], list[Repair]]:
    """Better lines of ``test.txt``; the same lines if no one names an image of the model."""
    index = NameIndex(names)
    lines: dict[str, None] = {}
    unknown = 0
    for entry in entries:
        fits = index.find(entry.name)
        if fits:
            lines[_one_name(fits, entry.name)] = None
        else:
            unknown += 1
    if not lines:
        return [entry.name for entry in entries], []
    repairs = []
    if unknown:
        gone = counted(unknown, "line")
        repairs.append(Repair("CS324", f"{gone} on images that are not in the model removed"))
    if twice := len(entries) - unknown - len(lines):
        repairs.append(Repair("CS326", f"{counted(twice, 'repeated line')} removed"))
    return list(lines), repairs


def _one_name(fits: Sequence[str], name: str) -> str:
    """The full name, if only one fits and it can stand in a line without becoming another one."""
    if len(fits) != 1 or fits[0] != fits[0].strip() or "\n" in fits[0] or "\r" in fits[0]:
        return name
    return fits[0]
