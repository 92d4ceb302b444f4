"""The network, its heads and calibration, and the files that hold them."""
