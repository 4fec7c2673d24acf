"""Scenes as anchors whose features are decoded into Gaussians; Scaffold-GS and ChronoGS use it."""
