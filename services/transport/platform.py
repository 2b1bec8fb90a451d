"""Choose the Dr.Jit back end once per process, after checking that it cannot abort the process.

Code that renders calls ``prepare_device`` before it imports a kernel, so that anything the machine lacks is reported
here, in one sentence. ``python -m services.transport.platform`` reports it too, and exits with status 4.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Literal

from services.core.errors import PlatformError
from services.core.records import Device

OLDEST_LLVM = 17
"""Oldest usable major version of libLLVM. Dr.Jit refuses versions 13 and 14 with a misleading sentence; versions 15 and
16 abort the process in the first kernel."""
LLVM_REMEDY = "install libllvm19 (or 18, 17), or set DRJIT_LIBLLVM_PATH to such a libLLVM.so"
PACKAGES = {"libatomic.so.1": "libatomic1", "libstdc++.so.6": "libstdc++6"}
"""Debian and Ubuntu package of each system library that Dr.Jit's wheel needs; a bare system lacks the first."""
_MISSING_LIBRARY = re.compile(r"(lib\S+?\.so[.\d]*): cannot open shared object file")


def import_renderer() -> tuple[ModuleType, ModuleType]:
    """The modules ``drjit`` and ``mitsuba``.

    Raises:
        PlatformError: a system library that their wheels need is missing; the message names it.
    """
    try:
        return importlib.import_module("drjit"), importlib.import_module("mitsuba")
    except ModuleNotFoundError:
        raise  # drjit or mitsuba itself is absent: the caller knows which extra installs it
    except (ImportError, NameError) as problem:  # drjit's own handler of a failed import raises a NameError
        for cause in _causes(problem):
            if missing := _MISSING_LIBRARY.search(str(cause)):
                package = PACKAGES.get(missing[1], f"the package of {missing[1]}")
                raise PlatformError(
                    f"The renderer needs {missing[1]}, which this machine lacks; install {package}."
                ) from problem
        raise PlatformError(f"The renderer cannot be loaded ({problem}); install drjit and mitsuba again.") from problem


def require_llvm(version: tuple[int, int, int]) -> None:
    """Refuse a missing or unusable libLLVM.

    Args:
        version: major, minor and patch number; (-1, -1, -1) when no libLLVM was found.

    Raises:
        PlatformError: names the version that was found and the package to install.
    """
    if version[0] < 0:
        raise PlatformError(f"No libLLVM was found, which the CPU renderer needs; {LLVM_REMEDY}.")
    if version[0] < OLDEST_LLVM:
        raise PlatformError(
            f"libLLVM {version[0]}.{version[1]} would crash the renderer, version {OLDEST_LLVM} or later is needed;"
            f" {LLVM_REMEDY}."
        )


def require_renderer() -> None:
    """Render one pixel of an empty scene, to check that the renderer works.

    Raises:
        PlatformError: the pixel cannot be rendered or is wrong; an unusable libLLVM may end the process instead.
    """
    prepare_device(threads=1)
    drjit, mitsuba = import_renderer()
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance"}
    sensor = {"type": "perspective", "film": film}
    scene = {"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, "light": {"type": "constant"}}
    try:
        image = mitsuba.render(mitsuba.load_dict(scene, optimize=False), spp=1)
        drjit.eval(image)
        value = float(image.array[0])
    except Exception as problem:
        raise PlatformError(
            f"The renderer cannot render a pixel here ({problem}); check libLLVM and the packages drjit and mitsuba."
        ) from problem
    if value != 1.0:
        raise PlatformError(f"The renderer sees {value:g} where a light of 1 is; check the packages drjit and mitsuba.")


def prepare_device(
    threads: int | None = None, backend: Device | None = None, colours: Literal["mono", "rgb"] = "mono"
) -> None:
    """Set Mitsuba's variant and Dr.Jit's thread count. Later calls with the same variant do nothing.

    Args:
        threads: CPU threads of this process; None keeps Dr.Jit's default.
        backend: ``llvm`` or ``cuda``; None keeps the back end that this process already uses, else ``llvm``.
        colours: ``mono`` for all fits; ``rgb`` for pictures of other people's scenes.

    Raises:
        PlatformError: a library is missing, the back end is not usable here, or another variant is already in use.
    """
    drjit, mitsuba = import_renderer()
    if backend is None:
        backend = "cuda" if (mitsuba.variant() or "").startswith("cuda") else "llvm"
    variant = f"{backend}_ad_{colours}"
    if mitsuba.variant() == variant:
        return
    if mitsuba.variant() is not None:
        raise PlatformError(
            f"This process already renders with {mitsuba.variant()}; start a new process for {variant}."
        )
    if backend == "llvm":
        require_llvm(tuple(drjit.detail.llvm_version()))
    elif not drjit.has_backend(drjit.JitBackend.CUDA):
        raise PlatformError("No CUDA device or driver was found; set device to llvm.")
    mitsuba.set_variant(variant)
    if threads is not None:
        drjit.set_thread_count(threads)


def _causes(problem: BaseException | None) -> Iterator[BaseException]:
    while problem is not None:
        yield problem
        problem = problem.__cause__ or problem.__context__


if __name__ == "__main__":
    try:
        require_llvm(tuple(import_renderer()[0].detail.llvm_version()))
    except PlatformError as problem:
        print(problem.message, file=sys.stderr)
        sys.exit(problem.exit_status)
