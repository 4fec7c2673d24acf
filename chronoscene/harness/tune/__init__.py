"""Search for options of a method: scenes and a preset go in, a preset file comes out.

`search` runs the trials, `report` writes what was found. Trials are scored on
views held back from the training views (``bench --validation``), and nothing else is known to them.
"""
