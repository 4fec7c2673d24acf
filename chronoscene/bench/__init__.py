"""The harness: strategies, training loop, prediction store, scores, tables, figures.

`runner.run_bench` runs jobs one by one, each in a process of its own (`worker`). A worker builds
the training sets (`protocol`), owns the loop (`training`), and writes images with a manifest
(`images`). Scores are made from those files alone (`scoring`), so a metric can be corrected without
training again. Nothing here but `worker` and what it calls imports torch.
"""
