"""``split.txt`` and ``test.txt`` written again: full names, single blanks, ids from 0 on.

Lines that contradict each other, fit several images or are no lines at all stay: what they mean is
for people to say.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

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
    index = NameIndex(names)
    found = {entry.line: index.find(entry.name) for entry in entries}
    used = {entry.period for entry in entries if len(found[entry.line]) == 1}
    ids = sorted({entry.period for entry in entries})
    new_ids = {old: new for new, old in enumerate(ids)}
    if ids != list(range(len(ids))):
        listed = ", ".join(f"{old} is now {new}" for old, new in list(new_ids.items())[:10])
        repairs.append(Repair("CS401", f"periods numbered from 0: {listed}"))
    lines, dropped, done = [], Counter[str](), set()
    by_line = {entry.line: entry for entry in entries}
    for number, line in enumerate(re.split("\r\n|\r|\n", text), start=1):
        entry = by_line.get(number)
        if entry is None:
            lines.append(" ".join(line.split()))
            continue
        fits = found[number]
        name = fits[0] if len(fits) == 1 and _is_line(fits[0]) else entry.name
        if not fits and entry.period in used:
            dropped["unknown"] += 1
        elif (name, entry.period) in done:
            dropped["twice"] += 1
        else:
            done.add((name, entry.period))
            lines.append(f"{name} {new_ids[entry.period]}")
    if dropped["unknown"]:
        gone = counted(dropped["unknown"], "line")
        repairs.append(Repair("CS309", f"{gone} on images that are not in the model removed"))
    if dropped["twice"]:
        repairs.append(Repair("CS308", f"{counted(dropped['twice'], 'repeated line')} removed"))
    return "".join(f"{line}\n" for line in lines if line), new_ids, repairs


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
            lines[fits[0] if len(fits) == 1 and _is_line(fits[0]) else entry.name] = None
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


def _is_line(name: str) -> bool:
    """Whether a name can stand in a line without becoming another one."""
    return name == name.strip() and "\n" not in name and "\r" not in name
