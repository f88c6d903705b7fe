"""Feature networks at run time: onnxruntime, shipped weights, no torch."""
