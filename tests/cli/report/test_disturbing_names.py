"""Names in runs of strangers that would be commands to a terminal are shown as text."""

import re

import made_runs
import pytest
from command_line import run_command

from chronoscene.harness.files.records import Failure, write_failure, write_summary
from chronoscene.io.tables import FORMATS

ESCAPE = "\x1b]0;title\x07\x1b[2J\u202e"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs and a failed one, with the escape sequence wherever a text is free."""
    runs = tmp_path_factory.mktemp("runs")
    for seed in range(2):
        made_runs.write_scored(
            runs,
            seed=seed,
            scene=f"plaza{ESCAPE}",
            title=f"3DGS{ESCAPE}",
            strategy=f"joint{ESCAPE}",
            preset=f"fast{ESCAPE}",
            variant=f"a={ESCAPE}",
            device=ESCAPE,
            commit=ESCAPE,
            skipped={"lpips_vgg": ESCAPE},
            notices=[ESCAPE],
            primitive=ESCAPE,
            period_labels={"0": f"2016{ESCAPE}", "1": ESCAPE},
        )
    failed = runs / "plaza" / "gone" / "seed0"
    failed.mkdir(parents=True)
    texts = {"method": "m", "strategy": "s", "preset": "p", "scene": "plaza", "reason": "r"}
    texts = {name: text + ESCAPE for name, text in texts.items()}
    write_failure(failed, Failure(seed=0, **texts))
    write_summary(runs)
    return runs


@pytest.mark.parametrize(
    "line",
    [
        *(f"table RUNS --format {style}" for style in FORMATS),
        *(f"tradeoff RUNS --format {style}" for style in ("table", "csv", "markdown", "latex")),
        *("compare RUNS", "compare RUNS --format csv", "compare RUNS --periods 0:1"),
        *("score RUNS", "verify RUNS", "methods 3dgs --runs RUNS", "submit RUNS --to RUNS/to"),
        "render RUNS/RUN --out RUNS/out",
    ],
)
def test_no_command_passes_them_on(runs, line):
    run = next(runs.glob("*/3dgs*/seed0")).relative_to(runs)
    words = [word.replace("RUNS/RUN", f"{runs}/{run}") for word in line.split()]
    result = run_command(*(word.replace("RUNS", str(runs)) for word in words), color=True)
    print(line, repr(result.output[:150]), len(result.output))
    assert result.output
    shown = re.sub(r"\x1b\[(0|1|3\d)m|\n", "", result.output)
    assert [c for c in shown if not c.isprintable()] == []
