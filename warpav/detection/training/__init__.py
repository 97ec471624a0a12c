"""Training of the shipped detector; the only place that needs PyTorch (extra ``train``)."""

CLASS_NAMES = ("car", "van", "lorry", "bus", "pedestrian", "cyclist")
"""Labels of the shipped detector, in the order of its output."""
