"""Checks of a scene folder: every problem, not only the first. No torch.

`run.validate_scene` gives a report; `rules/` has the rules, one file for each group; `rule` says
how to add one. The rules look at a `raw_scene.RawScene`, which reads whatever can be read of a
damaged scene, unlike `chronoscene.formats`, which stops at the first problem.
"""
