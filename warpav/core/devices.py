"""The devices that Warp finds on this machine."""

from __future__ import annotations

from warpav.core.errors import OptionError
from warpav.core.warp_setup import load_warp


def checked_device(device: str) -> str:
    """The name of a Warp device that this machine has.

    Raises:
        InputError: It has none of that name.
    """
    names = [each.alias for each in load_warp().get_devices()]
    if device not in names:
        raise OptionError("device", f"expected one of {', '.join(names)}, got {device!r}; warpav doctor lists them")
    return device


def device_name(device: str) -> str:
    """Alias and name of a Warp device, such as ``cuda:0 (NVIDIA H100)``."""
    found = load_warp().get_device(device)
    return f"{found.alias} ({found.name})"
