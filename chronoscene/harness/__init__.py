"""The benchmark: scenes and methods go in, runs with scores, tables and figures come out.

In the order of a run: `plan` lists the runs; `run` starts a process for each; `train` is that
process: training loop, checkpoints, test views; `score` compares images with the ground truth.
`files` holds the formats of all that a run leaves on disk, so a metric can be corrected without
training again. `report` makes tables, figures and pages of finished runs, `study` asks a question
about a method by several runs, `use` opens a trained run again, and `contract` checks plug-ins.
Only `train`, `use` and `contract` reach torch, and only through a method.
"""
