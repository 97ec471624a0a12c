"""Training of the built-in detector; needs PyTorch (extra ``train``)."""

CLASS_NAMES = ("car", "van", "lorry", "bus", "motorcycle", "pedestrian", "cyclist")
"""Labels of the shipped detector, in the order of its output."""
