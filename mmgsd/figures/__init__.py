"""Drawing: every function returns a Figure."""
