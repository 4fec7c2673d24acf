"""A scene in memory, and what can be computed from it alone. No torch.

`scene` has the records that formats return and everything else takes; `cameras`, `geometry`,
`similarity` and `tracks` compute with their arrays; `splits` reads period tables and test lists,
and `split_making` makes new splits.
"""

from chronoscene.scene.cameras import Camera
from chronoscene.scene.scene import Frame, Period, Points, Scene, Split, WorldFrame

__all__ = ["Camera", "Frame", "Period", "Points", "Scene", "Split", "WorldFrame"]
