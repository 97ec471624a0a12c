"""Renderers that are kept are limited by what their buffers hold."""

import math

import numpy as np
import pytest

from tests.driving_scene import camera_pose, on_device, packed_street
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import CHUNK_KEY_BYTES, KeptRenderers, chunk_view_count, equal_chunks
from warpav.raster.renderer import Renderer

SIZE = 96, 64


def renderer_of(views, device, *, lens="pinhole"):
    return Renderer([CameraModel(*SIZE, math.radians(80.0), lens=lens)] * views, device=device)


def rendered(renderer, device):
    pose = np.stack([camera_pose((1.0, 0.0, 1.8), 0.1 * k, 0.1) for k in range(renderer.view_count)])
    renderer.render(packed_street(device).raster, *on_device(pose, device), content=Content.ALL)
    return renderer


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_held_bytes_are_those_of_keys_rays_and_silhouettes(device, lens):
    new = renderer_of(3, device, lens=lens)
    before = new.held_bytes - new.strip.capacity  # a GPU's queue is there from the first
    found = rendered(new, device).held_bytes
    samples = (SIZE[0] + 2) * (SIZE[1] + 2)
    keys, rays = 8 * 3 * samples, 12 * samples if lens == "fisheye" else 0
    assert before < keys < found
    atlas = new.layers.crossing_key.capacity // 32 * (4 + 32 + 4 + 4)
    assert keys + rays + atlas <= found
    if device == "cpu":
        assert found < 1.3 * (keys + 1.5 * rays + atlas) + 50_000


def test_the_last_used_are_kept_as_far_as_they_fit():
    made = []

    def make(views):
        def new():
            made.append(views)
            return [rendered(renderer_of(views, "cpu"), "cpu")]

        return new

    one_byte = rendered(renderer_of(2, "cpu"), "cpu").held_bytes
    kept = KeptRenderers(bytes_max=int(2.5 * one_byte))
    a, b = kept.of("a", make(2)), kept.of("b", make(2))
    assert kept.of("a", make(2)) is a
    assert kept.of("b", make(2)) is b
    assert kept.of("a", make(2)) is a
    kept.of("c", make(2))  # three are too many, which the next call sees
    assert len(kept) == 3
    assert kept.of("c", make(2))
    assert len(kept) == 2
    assert kept.of("a", make(2)) is a
    large = kept.of("large", make(40))
    assert kept.of("large", make(40)) is large  # too many by themselves, and in use
    assert len(kept) == 1
    assert kept.of("a", make(2)) is not a
    assert len(kept) == 1
    assert made == [2, 2, 2, 40, 2]


def test_chunks_are_of_one_size_and_hold_every_view_once():
    for count, most in ((1, 5), (5, 5), (6, 5), (17, 4), (72, 64), (12, 1)):
        chunks = equal_chunks(count, most)
        assert {len(chunk) for chunk in chunks} == {-(-count // -(-count // most))}
        assert len(chunks[0]) <= most
        found = np.concatenate(chunks)
        np.testing.assert_array_equal(found[:count], np.arange(count))
        assert (found[count:] == count - 1).all()
        assert len(chunks) == -(-count // len(chunks[0]))
    assert equal_chunks(0, 3) == []


def test_views_at_once_follow_their_bytes():
    large = CameraModel(3840, 2160)
    assert chunk_view_count(large) == CHUNK_KEY_BYTES // (8 * 3842 * 2162) == 4
    assert chunk_view_count(large, key_bytes=2**26) == 1
    assert chunk_view_count(large, key_bytes=1) == 1
    assert chunk_view_count(CameraModel(1920, 1080), key_bytes=2**26) == 4
    assert chunk_view_count(CameraModel(256, 256), key_bytes=2**26) == 64
