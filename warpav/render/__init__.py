"""Floor 3: the renderer owns its buffers and the order of launches."""
