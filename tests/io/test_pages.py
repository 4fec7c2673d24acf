"""What pages share: pictures and tables inside of them."""

import base64
import io

import pytest
from jinja2 import Environment, FileSystemLoader
from PIL import Image

from chronoscene.io.pages import TEMPLATES, data_uri
from chronoscene.io.tables import Table


@pytest.mark.parametrize("form", ["jpeg", "webp"])
def test_pictures_are_in_the_page(form):
    start, _, data = data_uri(Image.new("RGBA", (30, 20), "red"), form=form).partition(",")
    assert start == f"data:image/{form};base64"
    picture = Image.open(io.BytesIO(base64.b64decode(data)))
    assert (picture.format, picture.size, picture.mode) == (form.upper(), (30, 20), "RGB")
    assert picture.getpixel((15, 10))[0] > 240 > 20 > picture.getpixel((15, 10))[2]


def test_tables_have_their_marks_and_names_are_only_text():
    table = Table(
        ["method", ("scene", "PSNR"), ("", "SSIM")],
        [["<b>A</b>", "21.0", "0.5"], ["B", "20.0", "0.6"]],
        title="a & b",
        ranks={(0, 1): 1, (1, 2): 1},
        ties={(1, 1)},
        breaks={0},
    )
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
    page = environment.get_template("shared/tables.html.j2").module.boxed(table)
    assert "<b>" not in page and "&lt;b&gt;A&lt;/b&gt;" in page and "a &amp; b" in page
    assert '<td class="rank1">21.0</td>' in page and '<td class="rank1">0.6</td>' in page
    assert '<td class="rank0">20.0 †</td>' in page
    assert page.count('<tr class="break">') == 1 and ">scene SSIM</th>" in page
