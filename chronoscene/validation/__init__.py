"""Checks of a scene folder that report every problem, not only the first. No torch.

In: a folder, however damaged. Out: a report of findings (`run.validate_scene`), as text, JSON,
SARIF or HTML (`report/`), or a corrected copy (`repair/`). `folder/` reads everything readable of
a damaged scene, unlike `chronoscene.formats`, which stops at the first problem; `checks/` derives
from it what several rules need; the rules are in `rules/`, in files named by the groups of their
codes. `rule` explains how to add one.
"""
