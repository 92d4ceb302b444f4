"""The explorer, ONNX, shipping and the sample: to be skipped on first reading."""
