"""The explorer, ONNX, packing and shipping: to be skipped on first reading."""
