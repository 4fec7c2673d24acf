"""Ray casting: geometry and light go in; images, depth and object maps come out.

`renderer` is the way in; `textures`, `light` and `shade` hold what it compiles.
"""
