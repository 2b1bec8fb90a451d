"""A request that differs from an earlier one only in pixels and seeds uses the kernel compiled for that one."""

from __future__ import annotations

from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import View
from tests.support.small_tooth import camera_at, recipe, whole_view


def test_new_pixels_and_seeds_need_no_new_kernel() -> None:
    # Every list has a different length, and is in NumPy memory that is aligned or not by chance.
    engine, tissue = Engine(recipe()), Tissue(Medium(2, 0.95), Medium(3, 0.8), (0.5, 0.4))
    import drjit as dr

    whole, hashes = whole_view(camera_at((0.2, 1, 0.1))), set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for count in range(40, 52):
            dr.kernel_history_clear()
            engine.images(tissue, View(whole.camera, whole.pixels[:count]), samples=2, seed=count, batches=2)
            hashes.add(max(dr.kernel_history(), key=lambda kernel: int(kernel.get("operation_count", 0)))["hash"])
    assert len(hashes) == 1
