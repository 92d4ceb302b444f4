"""From matches to actions: folding by one demonstration."""
