"""The summary page has everything that was made, and names are only text in it."""

import re
from html import unescape
from urllib.parse import unquote


def test_the_page_links_what_was_made(fake):
    fake.go()
    links = {unquote(unescape(link)) for link in re.findall(r'href="([^"]*)"', fake.html)}
    assert links == {
        "register/out/registration.html", "validate/index.html", "page/index.html",
        "export/2023 & more.ply",
    }  # fmt: skip
    assert fake.html.count("data:image/webp") == 2
    for text in ("the scene has no scale", "21.00", "25.00", "23.00", "chronoscene export"):
        assert text in fake.html, text


def test_names_are_escaped(fake):
    fake.go()
    assert "<before>" not in fake.html and "<words>" not in fake.html
    assert "May_2016 &amp; &lt;before&gt;" in fake.html
