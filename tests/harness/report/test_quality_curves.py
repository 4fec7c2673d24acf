"""Curves have the values of the probes, one line per model, and a legend that tells them apart."""

import re

from made_runs import record

from chronoscene.harness.files.records import CURVE_FILE
from chronoscene.harness.report.quality_curves import STYLES, draw_curves
from chronoscene.io.pages import TEMPLATES

HEADER = "seconds,iteration,primitives,psnr,parameters,model\n"


def run(folder, text, **changes):
    folder.mkdir()
    (folder / CURVE_FILE).write_text(HEADER + text)
    return record(folder=folder, **changes)


def test_every_finite_probe_is_drawn_with_its_values(tmp_path):
    joint = run(tmp_path / "a", "5,1,1,20,1,all\n10,2,1,24,1,all\n", method="a")
    parts = "2,1,1,21,1,period-0\n4,1,1,nan,1,period-0\n3,1,1,inf,1,period-1\n3,1,1,22,1,period-2\n"
    separate = run(tmp_path / "b", parts, method="b<i>", strategy="separate")
    (curves,) = draw_curves([joint, separate, record(folder=tmp_path)])
    assert re.findall("<title>(.*?)</title>", curves.svg) == [
        "A (joint, fast): 20.00 dB at 5.0 s",
        "A (joint, fast): 24.00 dB at 10.0 s",
        "B&lt;I&gt; (separate, fast), period-0: 21.00 dB at 2.0 s",
        "B&lt;I&gt; (separate, fast), period-2: 22.00 dB at 3.0 s",
    ]
    assert [*curves.legend] == ["A (joint, fast)", "B<I> (separate, fast)"]
    assert all(color in curves.svg for color, _ in curves.legend.values())
    assert (
        "training [s] on cpu (Test, 2 threads)</text>" in curves.svg
        and "PSNR [dB]</text>" in curves.svg
    )


def test_configurations_of_a_method_share_its_color_and_differ_in_style(tmp_path):
    found = [
        run(tmp_path / f"{method}{preset}", "5,1,1,20,1,all\n", method=method, preset=preset)
        for method in ("a", "b")
        for preset in ("fast", "paper")
    ]
    ((a, b, c, d),) = (plot.legend.values() for plot in draw_curves(found))
    assert a[0] == b[0] != c[0] == d[0]
    assert [style for _, style in (a, b, c, d)] == [*STYLES[:2], *STYLES[:2]]


def test_runs_of_other_programs_have_none(tmp_path):
    assert draw_curves([record(folder=tmp_path)]) == []


def test_devices_have_plots_of_their_own(tmp_path):
    probes = "5,1,1,20,1,all\n"
    found = [run(tmp_path / device, probes, device=device) for device in ("cpu", "cuda")]
    for device, plot in zip(("cpu", "cuda"), draw_curves(found), strict=True):
        assert f"training [s] on {device}</text>" in plot.svg


def test_the_label_does_not_collide_with_the_numbers_on_a_phone(tmp_path, browser):
    (curves,) = draw_curves([run(tmp_path / "a", "5,1,1,20,1,all\n10,2,1,24,1,all\n")])
    style = (TEMPLATES / "comparison" / "style.css").read_text(encoding="utf-8")
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.set_content(f"<style>{style}</style>{curves.svg}")
    found = page.locator(".plot text")
    boxes = {text.text_content(): text.bounding_box() for text in found.all()}
    label = boxes.pop("PSNR [dB]")
    assert all(box["x"] > label["x"] + label["width"] for box in boxes.values())
