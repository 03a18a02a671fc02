"""The training side: simulate, train, convert to ONNX. It needs torch; the runtime (edgefilter) never imports it."""
