"""From matches to a `Registered`: one model of all periods.

`estimation` chooses the route and reads its model; `routes` has the tasks of the worker process,
which the other modules serve; `extension` adds a period to a scene.
"""
