"""Blender scenes of cloth and rope with their labels; run as a child process: ``python -m mmgsd.scene``."""
