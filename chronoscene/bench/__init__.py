"""The benchmark: scenes and methods go in, runs with scores, tables and figures come out.

In the order of a run: `plan` lists the runs, each a `job`; `runner` executes them one by one in
`worker` processes. A worker builds the training sets (`strategies`), owns the loop
(`training_loop`, shown by `display`) and writes images with a manifest (`predictions`). Scores come
from these files alone (`scoring`), so a metric can be corrected without training again. `results`
holds the records with what made them (`provenance`); `tables` and `comparison_figure` show them.
Nothing here but `worker` and what it calls imports torch.
"""
