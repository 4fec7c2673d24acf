"""Self-contained HTML pages, made from the templates of this package."""

from __future__ import annotations

import base64
import io
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chronoscene.io.wording import counted

if TYPE_CHECKING:
    from jinja2 import Environment
    from PIL import Image

TEMPLATES = Path(__file__).parent / "templates"


def render_page(name: str, **values: Any) -> str:
    """Fill in ``templates/<name>.html.j2``; all values are escaped.

    In a template, ``{{ asset("shared/page.css") }}`` inserts a file of ``templates/`` unchanged,
    and ``{{ n|counted("scene") }}`` counts a noun.

    Args:
        name: Template, such as ``viewer/page``.
        values: Variables of the template.
    """
    return _environment().get_template(f"{name}.html.j2").render(**values)


@cache
def _environment() -> Environment:
    """Return the one environment, which compiles a template once."""
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    # The last line end goes: the template has one after the call.
    environment.filters["counted"] = counted
    environment.globals["asset"] = lambda file: Markup(
        (TEMPLATES / file).read_text(encoding="utf-8").removesuffix("\n")
    )
    return environment


def data_uri(picture: Image.Image, *, form: str = "jpeg", quality: int = 82) -> str:
    """Encode a picture as a data URI.

    Args:
        picture: Picture of any mode; converted to RGB.
        form: ``jpeg`` or ``webp``.
        quality: Pillow's quality, up to 100.
    """
    file = io.BytesIO()
    picture.convert("RGB").save(file, form, quality=quality)
    return f"data:image/{form};base64," + base64.b64encode(file.getvalue()).decode()
