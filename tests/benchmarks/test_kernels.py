"""Time, launches and buffers of every hot path of the renderer on the embedded workload.

Left out of the ordinary run; ``pytest tests/benchmarks --benchmark-only`` runs them. ``extra_info`` of a saved run
(``--benchmark-json=FILE``) holds what one call launches, and the bytes of all buffers on the device after it.
"""

import contextlib
import gc

import numpy as np
import pytest
import warp as wp

from warpav.experiments.bench.items import place_cameras
from warpav.experiments.bench.workload import embedded_workload, pack_workload
from warpav.raster.buffers import Content
from warpav.raster.renderer import Renderer


@pytest.fixture(scope="module")
def workload():
    """The embedded workload."""
    return embedded_workload()


class Work:
    """The workload's views on a device."""

    def __init__(self, workload, device):
        self.device = device
        self.scene = pack_workload(workload, device=device)
        self.models = workload.models(range(len(workload.pose)))
        self.pose = wp.array(workload.pose.astype(np.float32), dtype=wp.vec3, device=device, requires_grad=True)
        self.height_m = wp.array(workload.height_m.astype(np.float32), dtype=float, device=device)
        self.weight = wp.array(workload.weight["white"], dtype=float, device=device)
        self.views = place_cameras(self.pose, self.height_m)

    def renderer(self, supersampling=1):
        return Renderer(self.models, supersampling=supersampling, device=self.device)

    def rendered(self, supersampling=1, *, content=Content.ALL):
        return self.renderer(supersampling).render(self.scene, *self.views, content=content)


@pytest.fixture
def work(workload, device):
    """The workload on every device."""
    return Work(workload, device)


@contextlib.contextmanager
def counted_launches(monkeypatch):
    """A list that grows by one name with every launch, taped or not."""
    names = []
    launch, relaunch = wp.launch, wp.Launch.launch

    def count(kernel, *args, **kwargs):
        names.append(kernel.key)
        return launch(kernel, *args, **kwargs)

    def count_again(self, *args, **kwargs):
        names.append(self.kernel.key)
        return relaunch(self, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", count)
        patch.setattr(wp.Launch, "launch", count_again)
        yield names


def buffer_bytes(device):
    """Bytes of all arrays that own memory on the device."""
    gc.collect()
    found = [thing for thing in gc.get_objects() if type(thing) is wp.array]
    return sum(a.capacity for a in found if a.device == wp.get_device(device) and a.deleter is not None)


def measure(benchmark, monkeypatch, device, call):
    """Benchmark a call, each time until the device has done it."""

    def run():
        result = call()
        wp.synchronize_device(device)
        return result

    run()
    with counted_launches(monkeypatch) as names:
        kept = run()
    assert names
    benchmark.extra_info["launches"] = len(names)
    benchmark.extra_info["kernels"] = sorted(set(names))
    benchmark.extra_info["buffer_bytes"] = buffer_bytes(device)
    del kept
    benchmark.pedantic(run, rounds=9, warmup_rounds=1)


@pytest.mark.parametrize("supersampling", [1, 2])
@pytest.mark.parametrize("content", list(Content), ids=lambda content: content.value)
def test_render(benchmark, monkeypatch, work, supersampling, content):
    renderer = work.renderer(supersampling)
    measure(
        benchmark,
        monkeypatch,
        work.device,
        lambda: renderer.render(work.scene, *work.views, content=content),
    )


@pytest.mark.parametrize("supersampling", [1, 2])
@pytest.mark.parametrize("visible", [False, True], ids=["alone", "visible"])
def test_weighted_area(benchmark, monkeypatch, work, supersampling, visible):
    frame = work.rendered(supersampling, content=Content.ALL if visible else Content.OBJECTS)
    first = frame.weighted_area(work.weight, visible=visible)
    measure(
        benchmark,
        monkeypatch,
        work.device,
        lambda: frame.weighted_area(work.weight, visible=visible, into=first),
    )


@pytest.mark.parametrize("supersampling", [1, 2])
def test_measure(benchmark, monkeypatch, work, supersampling):
    frame = work.rendered(supersampling)
    first = frame.measure()
    measure(benchmark, monkeypatch, work.device, lambda: frame.measure(into=first))


def test_rgb(benchmark, monkeypatch, work):
    frame = work.rendered()
    measure(benchmark, monkeypatch, work.device, lambda: frame.colours())


def test_depth_and_object(benchmark, monkeypatch, work):
    frame = work.rendered()
    measure(benchmark, monkeypatch, work.device, lambda: frame.depths_and_ids())


def test_taped_part(benchmark, monkeypatch, work):
    measures = work.rendered(content=Content.OBJECTS).weighted_area(work.weight, visible=False)
    ones = wp.full(measures.value.shape, 1.0, dtype=float, device=work.device)

    def call():
        work.pose.grad.zero_()
        tape = wp.Tape()
        with tape:
            area = measures.on_tape(*place_cameras(work.pose, work.height_m))
        tape.backward(grads={area: ones})

    measure(benchmark, monkeypatch, work.device, call)
