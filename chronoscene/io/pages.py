"""HTML pages that need no other file: templates of this package with style and script inside."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from PIL import Image

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


def data_uri(picture: Image.Image, *, form: str = "jpeg", quality: int = 82) -> str:
    """A picture in a data URI.

    Args:
        picture: Of any mode; it becomes RGB.
        form: ``jpeg`` or ``webp``.
        quality: As Pillow counts it, up to 100.
    """
    file = io.BytesIO()
    picture.convert("RGB").save(file, form, quality=quality)
    return f"data:image/{form};base64," + base64.b64encode(file.getvalue()).decode()
