"""Measuring: how far answers are from the truth, and whether they know it."""
