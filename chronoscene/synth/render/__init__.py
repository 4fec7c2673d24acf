"""Ray casting: textures, light and compiled shading."""
