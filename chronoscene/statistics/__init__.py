"""Statistics of scenes by period: a scene goes in, counts and measures come out, then tables.

`counts` has images and points and the table as in the paper, `measures` tracks, errors, baselines,
coverage and what periods see of each other, and `details` the table of everything.
"""
