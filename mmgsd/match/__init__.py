"""Answering: from descriptors to all matches of a pixel."""
