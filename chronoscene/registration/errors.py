"""What can go wrong in a registration that is nobody's programming mistake."""

from __future__ import annotations

from chronoscene.errors import ChronoSceneError


class RegistrationError(ChronoSceneError):
    """Photos that do not give a model, or a step that ended early; what was computed is kept."""
