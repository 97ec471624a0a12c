"""The server's end of CARLA: its client package, whether a server is there, what its blueprints are."""

from __future__ import annotations

import importlib
import re
import socket
import time
from collections.abc import Mapping
from types import ModuleType
from typing import Any, TypeAlias

from warpav.core.errors import InputError, install_text

Remote: TypeAlias = Any
"""Something that the optional package ``carla`` defines; its types cannot be named here."""

REACH_S = 2.5
"""Time within which a server answers [s]."""

VERSION_REQUEST = b"\x94\x00\x01\xa7version\x91\x91\xc2"  # MessagePack: [request, number 1, "version", [[false]]]
_ANSWER_BEGINS = b"\x94\x01\x01"  # [answer, number 1,
_CATEGORY_OF_BASE_TYPE = {"car": "car", "van": "van", "truck": "lorry", "bus": "bus"}


def import_carla() -> ModuleType:
    """The client package."""
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        raise InputError(f"CARLA: expected its Python client 0.9.16, got: {error}; {install_text('carla')}") from None


def unreachable(host: str, port: int) -> str | None:
    """Why no CARLA server is there, or None.

    It is queried for its version with the client's own request: any other service would crash the client's process.
    """
    deadline_s = time.monotonic() + REACH_S
    fault = "no address"
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        return f"the host's name is not known ({error.strerror or error})"
    for family, kind, protocol, _, address in addresses:
        try:
            with socket.socket(family, kind, protocol) as probe:
                probe.settimeout(max(deadline_s - time.monotonic(), 0.05))
                probe.connect(address)
                probe.settimeout(max(deadline_s - time.monotonic(), 0.05))
                probe.sendall(VERSION_REQUEST)
                answer, length = b"", len(_ANSWER_BEGINS)
                while len(answer) < length and (part := probe.recv(length - len(answer))):
                    answer += part
                if answer == _ANSWER_BEGINS:
                    return None
                fault = "an answer that is not CARLA's"
        except TimeoutError:
            fault = f"no answer within {REACH_S:g} s"
        except OSError as error:
            fault = (error.strerror or str(error)).lower()
    return fault


def release_of(version: str) -> str:
    """``0.9.16`` of ``0.9.16-2-gabcdef``; builds from source describe themselves so."""
    match = re.match(r"\d+\.\d+\.\d+", version)
    return match.group() if match else version


def clear_noon(carla: ModuleType) -> Remote:
    """Clear and windless, the sun overhead; shadows lie below what casts them."""
    calm = ("cloudiness", "precipitation", "precipitation_deposits", "wind_intensity", "fog_density", "wetness")
    return carla.WeatherParameters(**dict.fromkeys(calm, 0.0), sun_altitude_angle=90.0)


def set_attributes(blueprint: Remote, values: Mapping[str, str | None]) -> None:
    """Those that the blueprint has and lets be changed."""
    for name, value in values.items():
        if value is not None and blueprint.has_attribute(name) and blueprint.get_attribute(name).is_modifiable:
            blueprint.set_attribute(name, value)


def colours_of(blueprint: Remote) -> list[str]:
    """The colours that a blueprint recommends."""
    return list(blueprint.get_attribute("color").recommended_values) if blueprint.has_attribute("color") else []


def category_of(blueprint: Remote) -> str | None:
    """What a blueprint is: car, van, lorry or bus; None for what has two wheels, or none."""
    if blueprint.has_attribute("base_type"):
        base_type = blueprint.get_attribute("base_type").as_str().lower()
        if base_type:
            return _CATEGORY_OF_BASE_TYPE.get(base_type)
    wheels = blueprint.get_attribute("number_of_wheels").as_int() if blueprint.has_attribute("number_of_wheels") else 0
    return "car" if wheels >= 4 else None
