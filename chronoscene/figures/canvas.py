"""Common parts of figures: look, colours of periods, legend, files and pages."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from textwrap import shorten
from typing import Any
from warnings import catch_warnings, filterwarnings

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from chronoscene.io.staging import replacing
from chronoscene.io.wording import printable

DPI = 200  # Pixels per inch of PNG files, and of the density inside PDF and SVG files
WIDE_FONTS = (
    *("Noto Sans CJK SC", "Noto Sans CJK JP", "Noto Sans SC", "Source Han Sans SC"),
    *("WenQuanYi Zen Hei", "WenQuanYi Micro Hei", "Droid Sans Fallback", "Arial Unicode MS"),
    *("PingFang SC", "Heiti TC", "Microsoft YaHei", "SimHei", "Malgun Gothic", "Noto Sans"),
)
"""With letters that are not European, on the usual systems."""
GREY = "#555555"
UNSEEN, UNSEEN_COLOR = "seen by no image", "#808080"
"""Name and colour of points without a period."""
GRID = "#dddddd"


def new_figure(width: float, height: float, *, layout: Any = None, dpi: int = DPI) -> Any:
    """Make a matplotlib figure of a size in inches, without pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def plain(text: str) -> str:
    """Escape a name for matplotlib: no formula, and no character that it cannot draw."""
    return printable(text).replace("$", r"\$")


def plain_lines(text: str) -> str:
    """Escape as `plain` does, but keep the ends of lines."""
    return "\n".join(map(plain, text.split("\n")))


def save(figure: Any, path: Path, **options: Any) -> None:
    """Write a figure in the format that the suffix names; equal figures give equal bytes.

    ``options`` are for `Figure.savefig`.
    """
    from matplotlib import rc_context

    form = path.suffix.lstrip(".").lower()
    path.parent.mkdir(parents=True, exist_ok=True)
    by_format: dict[str, dict[str, Any]] = {
        # Faster by half than the usual level 6, and larger by 3 %.
        "png": {"pil_kwargs": {"compress_level": 4}},
        "pdf": {"metadata": {"CreationDate": None}},
        "svg": {"metadata": {"Date": None}},
    }
    settings: Any = {"svg.hashsalt": "chronoscene", "pdf.fonttype": 42}
    _choose_fonts(figure)
    with rc_context(settings), replacing(path) as partial, catch_warnings():
        filterwarnings("ignore", "Glyph .* missing")  # no font here has it: boxes stand for it
        figure.savefig(partial, format=form, **by_format[form], **options)


def inline_svg(figure: Any, label: str, titles: Mapping[str, str]) -> Markup:
    """Return a figure as an ``<svg>`` element for a page; equal figures give equal text.

    Letters are text in the page, so that they can be selected and searched.

    Args:
        figure: The figure.
        label: Description for readers who do not see it.
        titles: What a browser shows while it points at an artist, by the gid of the artist.
    """
    from matplotlib import rc_context

    text = StringIO()
    with rc_context({"svg.hashsalt": "chronoscene", "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    # What stands before the first group is for files. Names of groups would clash in a page.
    body = text.getvalue()
    body = re.sub(
        '<g id="(.*?)">',
        lambda found: (
            Markup("<g><title>{}</title>").format(titles[found[1]]) if found[1] in titles else "<g>"
        ),
        body[body.index("<g ") :],
    )
    width, height = figure.get_size_inches() * 72
    return Markup(
        '<svg class="plot" viewBox="0 0 {:g} {:g}" role="img" stroke-linejoin="round" '
        'aria-label="{}">\n{}'
    ).format(width, height, label, Markup(body))


def add_legend(figure: Any, entries: Sequence[tuple[str, str]], columns: int, **place: Any) -> None:
    """Add names beside squares of their colours, line by line; ``place`` is for `Figure.legend`."""
    from matplotlib.patches import Patch

    columns = min(columns, len(entries))
    # Matplotlib fills legends column by column.
    entries = [entry for column in range(columns) for entry in entries[column::columns]]
    figure.legend(
        [Patch(color=color) for _, color in entries],
        [plain(name) for name, _ in entries],
        ncols=columns,
        borderaxespad=0,
        frameon=False,
        fontsize=9,
        handlelength=1.0,
        handleheight=1.0,
        columnspacing=1.4,
        **place,
    )


def short_name(name: str, length: int = 28) -> str:
    """Shorten a name for a legend, or to another number of characters."""
    return shorten(printable(name), length, placeholder="...") or name[:length]


def quiet_axes(axes: Any) -> None:
    """Draw frame and ticks thin and grey."""
    for spine in axes.spines.values():
        spine.set_color("#999999")
        spine.set_linewidth(0.6)
    axes.tick_params(labelsize=8, colors=GREY, width=0.6, length=3)
    axes.set_axisbelow(True)


def _choose_fonts(figure: Any) -> None:
    """Choose fonts of this machine for letters that the usual one lacks."""
    from matplotlib.font_manager import fontManager
    from matplotlib.text import Text

    other = [text for text in figure.findobj(Text) if not text.get_text().isascii()]
    if other:
        here = {font.name for font in fontManager.ttflist}
        for text in other:
            text.set_fontfamily(["DejaVu Sans", *(f for f in WIDE_FONTS if f in here)])


FOUR = ("#b5121b", "#f5c211", "#2458c8", "#55c878")
"""Red, yellow, blue, green: the colours of the paper's figures for up to four periods. The red is
dark and the green light, so that they differ for the colour-blind, too."""

EIGHT = (
    *("#124595", "#ff9103", "#00a769", "#a468d0"),
    *("#32cfff", "#c83b11", "#694557", "#ffd151"),
)
"""Told apart on white and on dark grounds with any form of colour blindness.

Source: hues of Okabe and Ito 2008, with grey for black, moved apart until the smallest distance
between two of them, or one and a ground, was largest for all three forms in the model of Machado,
Oliveira and Fernandes 2009.
"""

_RAMP = ("#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#e8d21d")
"""Dark to light, so the order can be seen without colours. Source: viridis, the end darkened."""


def period_colors(periods: int) -> list[str]:
    """Return colours as ``#rrggbb``: four or eight that are far apart, else a ramp."""
    for palette in (FOUR, EIGHT):
        if periods <= len(palette):
            return list(palette[:periods])
    anchors = np.array([rgb_of(color) for color in _RAMP])
    at = np.linspace(0, len(anchors) - 1, periods)
    channels = [np.interp(at, np.arange(len(anchors)), anchors[:, c]) for c in range(3)]
    return ["#{:02x}{:02x}{:02x}".format(*map(round, rgb)) for rgb in zip(*channels, strict=True)]


def rgb_of(color: str) -> NDArray[np.float64]:
    """Return red, green and blue, 0..255, of ``#rrggbb``. [3]"""
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)], np.float64)
