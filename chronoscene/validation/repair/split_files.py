"""``split.txt`` and ``test.txt`` written again: full names, single blanks, ids from 0 on.

Lines that contradict each other, fit several images or are no lines at all stay: what they mean is
for people to say.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from chronoscene.io.wording import counted
from chronoscene.scene.splits import NameEntry, NameIndex, SplitEntry
from chronoscene.validation.checks.spelling import PUNCTUATION, Spellings, spelling
from chronoscene.validation.repair.colmap_model import Repair


def repair_split(
    data: bytes,
    text: str,
    names: Sequence[str],
    entries: Sequence[SplitEntry],
    others: Sequence[str] = (),
) -> tuple[str, dict[int, int], list[Repair]]:
    """A better ``split.txt``.

    Args:
        data: The file.
        text: The same, decoded.
        names: Full names of the registered images.
        entries: Its readable lines.
        others: Names in the model that no image can have. Lines on them stay.

    Returns:
        The new text; new ids by the old ones; what was done.
    """
    repairs = _line_repairs(data, text)
    ids = sorted({entry.period for entry in entries})
    new_ids = {old: new for new, old in enumerate(ids)}
    if ids != list(range(len(ids))):
        listed = ", ".join(f"{old} is now {new}" for old, new in list(new_ids.items())[:10])
        repairs.append(Repair("CS401", f"periods numbered from 0: {listed}"))
    lines, unknown, twice, misspelt = _split_lines(text, names, entries, new_ids, others)
    index = NameIndex(names)
    known = set(names)
    if short := sum(len(index.find(e.name)) == 1 and e.name not in known for e in entries):
        repairs.append(Repair("", f"{counted(short, 'name')} written in full"))
    if misspelt:
        repairs.append(Repair("CS305", f"{counted(misspelt, 'name')} corrected as in the model"))
    if unknown:
        gone = counted(unknown, "line")
        repairs.append(Repair("CS309", f"{gone} on images that are not in the model removed"))
    if twice:
        repairs.append(Repair("CS308", f"{counted(twice, 'repeated line')} removed"))
    return "".join(f"{line}\n" for line in lines if line), new_ids, repairs


def _split_lines(
    text: str,
    names: Sequence[str],
    entries: Sequence[SplitEntry],
    new_ids: Mapping[int, int],
    others: Sequence[str],
) -> tuple[list[str], int, int, int]:
    """New lines; how many are left out, of unknown images and repeated ones; misspelt names."""
    index = NameIndex(names)
    by_line = {entry.line: (entry, index.find(entry.name)) for entry in entries}
    listed = {fits[0] for _, fits in by_line.values() if len(fits) == 1}
    spellings, impossible = Spellings(set(names) - listed), Spellings(others)
    for number, (entry, fits) in by_line.items():
        if not fits and (name := _meant(spellings, entry.name)) is not None:
            by_line[number] = (entry, [name])
    used = {entry.period for entry, fits in by_line.values() if len(fits) == 1}
    lines: list[str] = []
    unknown = twice = misspelt = 0
    done: set[tuple[str, int]] = set()
    for number, line in enumerate(re.split("\r\n|\r|\n", text), start=1):
        if number not in by_line:
            lines.append(" ".join(line.split()))
            continue
        entry, fits = by_line[number]
        name = _one_name(fits, entry.name)
        if not fits and entry.period in used and impossible.find(entry.name) is None:
            unknown += 1
        elif (name, entry.period) in done:
            twice += 1
        else:
            done.add((name, entry.period))
            misspelt += not index.find(entry.name) and bool(fits)
            lines.append(f"{name} {new_ids[entry.period]}")
    return lines, unknown, twice, misspelt


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


def plain_table(text: str, names: Sequence[str]) -> tuple[str, list[Repair]]:
    """A table with commas, semicolons or quotes as one with blanks, where its names are images."""
    index, spellings = NameIndex(names), Spellings(names)
    lines, changed, code = re.split("(\r\n|\r|\n)", text), 0, ""
    for i in range(0, len(lines), 2):
        found = re.fullmatch(r"\s*[\"']?(.+?)[\"']?\s*[,;]\s*[\"']?([0-9]{1,9})[\"']?\s*", lines[i])
        if found and (index.find(found[1]) or _meant(spellings, found[1])):
            code = "CS305" if len(lines[i].split()) > 1 else "CS303"  # what it was reported as
            lines[i] = f"{found[1]} {found[2]}"
            changed += 1
    what = f"blanks instead of commas in {counted(changed, 'line')}"
    return "".join(lines), [Repair(code, what)] if changed else []


def _meant(spellings: Spellings, text: str) -> str | None:
    """The image that a name means but for case, Unicode form, quotes or folders above it."""
    name, full = spellings.find(text), spelling(text.strip(PUNCTUATION))
    if name is None:
        return None
    known = spelling(name)
    same = full in (known, known.rpartition("/")[2]) or full.endswith(f"/{known}")
    return name if same else None


def repair_test(
    names: Sequence[str], entries: Sequence[NameEntry]
) -> tuple[list[str], list[Repair]]:
    """Better lines of ``test.txt``; the same lines if no one names an image of the model."""
    index, spellings = NameIndex(names), Spellings(names)
    lines: dict[str, None] = {}
    unknown = renamed = 0
    for entry in entries:
        fits = index.find(entry.name)
        for text in (entry.name, entry.name.rsplit(maxsplit=1)[0]):  # some add the period
            if not fits and (name := _meant(spellings, text)) is not None:
                fits, renamed = [name], renamed + 1
        if fits:
            lines[_one_name(fits, entry.name)] = None
        else:
            unknown += 1
    if not lines:
        return [entry.name for entry in entries], []
    repairs = []
    if renamed:
        repairs.append(Repair("CS324", f"{counted(renamed, 'name')} corrected as in the model"))
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
