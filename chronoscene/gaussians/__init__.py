"""Scenes as explicit Gaussians: parameters, colours, density control."""
