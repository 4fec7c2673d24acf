"""The bar charts of what scenes need."""

from made_runs import record
from matplotlib.figure import Figure

from chronoscene.figures import canvas
from chronoscene.harness.report.figures.sharing import draw_sharing
from chronoscene.methods import PeriodSharing


def shared(*blocks):
    return PeriodSharing(blocks, (1,) * len(blocks), 0, 1)


def test_scenes_with_shares_are_drawn_and_no_others(tmp_path, monkeypatch):
    drawn: list[Figure] = []
    save = canvas.save
    monkeypatch.setattr(
        canvas, "save", lambda figure, path: (drawn.append(figure), save(figure, path))
    )
    runs = [
        record("3dgs"),
        record(sharing=shared(3, 1)),
        record(seed=1, sharing=shared(1, 1)),
        record(preset="balanced", sharing=shared(4, 0)),
        record(scene="a$b", sharing=shared(1, 2, 1)),
    ]
    assert draw_sharing(tmp_path, runs[:1]) == [] == drawn
    assert draw_sharing(tmp_path, runs) == [tmp_path / "figures/blocks.png"]
    (figure,) = drawn
    heights = [[bar.get_height() for bar in axes.patches] for axes in figure.axes]
    assert heights == [[62.5, 37.5, 100, 0], [25, 50, 25]]
    assert (tmp_path / "figures/blocks.png").stat().st_size > 1000
