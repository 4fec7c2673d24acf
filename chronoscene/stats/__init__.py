"""Statistics of scenes by period: a scene goes in, counts and measures come out, then tables.

`counts` has images and points and the table as in the paper, `measures` tracks, errors, baselines
and coverage, `view_overlap` what the cameras of one period have in view of another, and `details`
the table of everything.
"""
