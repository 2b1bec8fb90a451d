"""The peer of this engine's gradients: stock ``prbvolpath`` with a backward pass through the image of one light.

It gives derivatives with respect to sigma, alpha, g and the lobes' weight only, not with respect to its dentin surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import View


def shared_names(tissue: Tissue) -> tuple[str, ...]:
    """Return the names of the parameters that both engines have; those of a second lobe only where there is one."""
    media = {"enamel": tissue.enamel, "dentin": tissue.dentin}
    fields = {
        part: ("sigma", "alpha", "beta", "g1", "g2") if medium.beta < 1 else ("sigma", "alpha", "g1")
        for part, medium in media.items()
    }
    return tuple(f"{part}.{field}" for part, names in fields.items() for field in names)


class StockGradient:
    """Gradient of 1/2 sum (C - reference)^2 over a view's pixels, under the light of the scene of ``nested_scene``."""

    def __init__(self, scene: Any, tissue: Tissue, view: View) -> None:
        import drjit as dr
        import mitsuba as mi

        self._scene, self._params, self._size = scene, mi.traverse(scene), view.camera.size
        self._x, self._y = view.pixels.T
        self.names = shared_names(tissue)
        two_lobes = {part for part in ("enamel", "dentin") if f"{part}.beta" in self.names}
        self._keys = [_key(name, two_lobes) for name in self.names]
        for key in self._keys:
            dr.enable_grad(self._params[key])

    def __call__(self, reference: NDArray[np.float64], *, samples: int, seed: int) -> NDArray[np.float64]:
        """Return the gradient (F,) in the order of ``names``, from one image and, with an independent seed, one
        backward pass.

        Args:
            reference: radiance (N,) of the view's pixels.
            samples: paths per pixel of each of the two passes.
            seed: seed from which those of both passes are derived.
        """
        import drjit as dr
        import mitsuba as mi

        with dr.suspend_grad():
            image = np.array(mi.render(self._scene, spp=samples, seed=2 * seed), dtype=np.float64)[..., 0]
        width, height = self._size
        residual = np.zeros((height, width, 1), dtype=np.float32)
        residual[self._y, self._x, 0] = image[self._y, self._x] - reference
        for key in self._keys:
            dr.set_grad(self._params[key], 0)
        self._scene.integrator().render_backward(
            self._scene, self._params, mi.TensorXf(residual), seed=2 * seed + 1, spp=samples
        )
        gradients = [float(dr.grad(self._params[key])[0]) for key in self._keys]
        # Mitsuba's weight is that of the second lobe, so the derivative with respect to beta has the opposite sign.
        return np.array([-g if name.endswith(".beta") else g for name, g in zip(self.names, gradients, strict=True)])


def _key(name: str, two_lobes: set[str]) -> str:
    part, field = name.split(".")
    leaf = {
        "sigma": "sigma_t.value.value",
        "alpha": "albedo.value.value",
        "beta": "phase_function.weight.value.value",
        "g1": "phase_function.phase_0.g" if part in two_lobes else "phase_function.g",
        "g2": "phase_function.phase_1.g",
    }[field]
    return f"medium_{part}.{leaf}"
