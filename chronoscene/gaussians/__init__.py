"""Scenes as explicit Gaussians, as in 3DGS: what methods build on that store every Gaussian.

In: a `TrainingSet` and a `GaussianConfig`. Out: a trained `GaussianModel`, and `GaussianMethod`,
the base class of the plug-ins. What a method adds to static Gaussians, such as a deformation field,
goes into `GaussianModel.at_period`.
"""
