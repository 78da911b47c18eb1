"""Markers with the interface of ``isaaclab.markers``, which draw nothing: recordings show robots, not markers."""

from __future__ import annotations

__path__: list[str] = []  # ``isaaclab`` makes the module ``markers.config``


class VisualizationMarkersCfg:
    """The settings of markers. Any settings are accepted, but have no effect."""

    def __init__(self, **settings: object) -> None:
        vars(self).update(settings)

    def replace(self, **settings: object) -> VisualizationMarkersCfg:
        """Return a copy with other settings."""
        return VisualizationMarkersCfg(**{**vars(self), **settings})

    def copy(self) -> VisualizationMarkersCfg:
        """Return a copy."""
        return self.replace()


class VisualizationMarkers:
    """Markers that are never drawn."""

    def __init__(self, cfg: object = None) -> None:
        self.cfg = cfg

    def set_visibility(self, visible: bool) -> None: ...

    def is_visible(self) -> bool:
        return False

    def visualize(self, *args: object, **kwargs: object) -> None: ...
