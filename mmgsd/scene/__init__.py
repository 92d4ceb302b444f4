"""Blender scenes of cloth and rope with their labels; run as a child process: ``python -m mmgsd.scene``."""


class SceneError(RuntimeError):
    """A random scene did not come about in as many tries as it is given; the message says what was tried."""
