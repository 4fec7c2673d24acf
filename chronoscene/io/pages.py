"""HTML pages that need no other file: templates of this package with style and script inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

TEMPLATES = Path(__file__).parent / "templates"


def render_page(name: str, **values: Any) -> str:
    """Fill in ``templates/<name>.html.j2``; all values are escaped.

    In a template, ``{{ asset("page.css") }}`` is the text of a file beside it, as it is.

    Args:
        name: Of the template.
        values: What the template calls by name.
    """
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    # The last line end goes: the template has one after the call.
    environment.globals["asset"] = lambda file: Markup(
        (TEMPLATES / file).read_text(encoding="utf-8").removesuffix("\n")
    )
    return environment.get_template(f"{name}.html.j2").render(**values)
