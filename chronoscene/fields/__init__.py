"""Radiance fields: density and colour at places along rays, and the training of methods on them.

What comes in is a `TrainingSet`; a subclass of `method.FieldMethod` says what the field is made of.

- `box`: the part of space that the sparse points span, and the contraction of the rest.
- `occupancy`, `marching`: where rays are sampled, for each period.
- `grid`: the code of a place; `mlp`: small networks; `compositing`: sums along rays; `rows`: parts
  of rays.
- `rays`: pixels of all photos, and their rays. `network`: a field of these; `method`: training.

`marching`, `grid`, `mlp`, `compositing` and `rows` have a definition in plain torch each, which a
GPU runs, and kernels for float32 on a CPU, those of `grid` and `mlp` in ``*_kernels``. Values and
gradients of the kernels have equal bits for any number of threads. On a GPU pixels, occupancy and
samples stay there; a step asks it twice how many samples there are, and once how it went.
"""
