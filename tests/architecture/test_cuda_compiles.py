"""Every module of kernels compiles for CUDA GPUs, on a machine without one too; nothing is run."""

import functools
import importlib
import re
import tempfile
from pathlib import Path

import pytest
import warp as wp

from tests.architecture.kernel_style import read_modules
from warpav.core.files import atomic_write

# Turing, Ampere, Hopper; the first two are left to full runs: each takes half a minute of one core
ARCHITECTURES = (pytest.param(75, marks=pytest.mark.slow), pytest.param(80, marks=pytest.mark.slow), 90)
KERNELS = Path(__file__).parents[2] / "kernels"
MODULES = [
    pytest.param(module, id=Path(module.path).stem)
    for module in read_modules(KERNELS / "warpav_kernels")
    if any(function.kind == "kernel" for function in module.functions)
]


def name_of(module):
    """Dotted name of a module of kernels."""
    return ".".join(Path(module.path).relative_to(KERNELS).with_suffix("").parts)


@functools.cache
def ptx(name, architecture):
    """The assembly of one module, compiled anew where its code changed: kept beside the kernels that Warp keeps."""
    module = importlib.import_module(name)
    content = wp.get_module(name).hash_module().hex()
    kept = Path(wp.config.kernel_cache_dir) / "ptx" / f"{name}_{content}_{architecture}.ptx"
    if not kept.is_file():
        with tempfile.TemporaryDirectory() as folder:
            (file,) = wp.compile_aot_module(module, device=None, arch=architecture, module_dir=folder, use_ptx=True)
            kept.parent.mkdir(exist_ok=True)
            with atomic_write(kept) as draft:
                draft.write_bytes(Path(file).read_bytes())
    return kept.read_text()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("module", MODULES)
def test_module_compiles_for_cuda(module, architecture):
    text = ptx(name_of(module), architecture)
    assert f".target sm_{architecture}" in text
    entries = re.findall(r"\.entry (\w+?)_[0-9a-f]{8}_cuda_kernel_(forward|backward)\(", text)
    for kernel in (function for function in module.functions if function.kind == "kernel"):
        assert (kernel.name, "forward") in entries
        assert ((kernel.name, "backward") in entries) == kernel.is_differentiable(module.enable_backward)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_the_nearest_surface_is_kept_by_native_atomics(architecture):
    # the keys of depth buffers have 64 bits; without the instruction it would be a loop of compare and swap
    text = ptx("warpav_kernels.raster._rasterise", architecture)
    assert re.search(r"\b(atom|red)(\.\w+)*\.max\.s64\b", text)
    assert not re.search(r"\b(atom|red)(\.\w+)*\.cas\.b64\b", text)
