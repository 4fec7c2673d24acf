"""A finished run, or a scene, in; maps, point clouds and differences of its periods out.

All that is written is in *map coordinates*: east, north and height in metres, by `map_frame`.
"""
