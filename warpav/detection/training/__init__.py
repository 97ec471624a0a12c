"""Training of the shipped detector; the only place that needs PyTorch (extra ``train``)."""
