"""Learning: the network, its losses and the training."""
