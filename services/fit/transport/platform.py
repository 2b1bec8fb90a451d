"""Choose the Dr.Jit back end once per process, after checking that it cannot abort the process."""

from __future__ import annotations

import importlib
from typing import Literal

from services.core.errors import PlatformError
from services.core.records import Device

OLDEST_LLVM = 17
"""libLLVM 13 and 14 are refused by Dr.Jit with a misleading sentence; 15 and 16 abort the process in the first kernel."""


def require_llvm(version: tuple[int, int, int]) -> None:
    """Refuse a missing or unusable libLLVM by its version, (-1, -1, -1) when none was found.

    Raises:
        PlatformError: names what was found and what to install.
    """
    remedy = "install libllvm19 (or 18, 17), or set DRJIT_LIBLLVM_PATH to such a libLLVM.so"
    if version[0] < 0:
        raise PlatformError(f"No libLLVM was found, which the CPU renderer needs; {remedy}.")
    if version[0] < OLDEST_LLVM:
        raise PlatformError(f"libLLVM {version[0]}.{version[1]} would crash the renderer, version {OLDEST_LLVM} or later is needed; {remedy}.")


def require_renderer() -> None:
    """Render one pixel of an empty scene.

    Raises:
        PlatformError: that does not work; an unusable libLLVM may end the process instead.
    """
    prepare_device(threads=1)
    mitsuba = importlib.import_module("mitsuba")
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance"}
    sensor = {"type": "perspective", "film": film}
    scene = {"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, "light": {"type": "constant"}}
    try:
        image = mitsuba.render(mitsuba.load_dict(scene, optimize=False), spp=1)
        importlib.import_module("drjit").eval(image)
        value = float(image.array[0])
    except Exception as problem:
        raise PlatformError(f"The renderer cannot render a pixel here ({problem}); check libLLVM and the packages drjit and mitsuba.") from problem
    if value != 1.0:
        raise PlatformError(f"The renderer sees {value:g} where a light of 1 is; check the packages drjit and mitsuba.")


def prepare_device(threads: int | None = None, backend: Device | None = None, colours: Literal["mono", "rgb"] = "mono") -> None:
    """Set Mitsuba's variant and Dr.Jit's thread count. Later calls with the same back end do nothing.

    Args:
        threads: CPU threads of this process; None keeps Dr.Jit's default.
        backend: ``llvm`` or ``cuda``; None takes what this process already uses, else ``llvm``.
        colours: ``mono`` for everything that fits; ``rgb`` for pictures of other people's scenes.

    Raises:
        PlatformError: the back end is not usable here, or another one is already in use.
    """
    drjit = importlib.import_module("drjit")
    mitsuba = importlib.import_module("mitsuba")
    if backend is None:
        backend = "cuda" if (mitsuba.variant() or "").startswith("cuda") else "llvm"
    variant = f"{backend}_ad_{colours}"
    if mitsuba.variant() == variant:
        return
    if mitsuba.variant() is not None:
        raise PlatformError(f"This process already renders with {mitsuba.variant()}; start a new process for {variant}.")
    if backend == "llvm":
        require_llvm(tuple(drjit.detail.llvm_version()))
    elif not drjit.has_backend(drjit.JitBackend.CUDA):
        raise PlatformError("No CUDA device or driver was found; set device to llvm.")
    mitsuba.set_variant(variant)
    if threads is not None:
        drjit.set_thread_count(threads)
