"""A measured phase function as Mitsuba's ``tabphase`` takes it, and a small scene around it that stock Mitsuba
renders.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import Cell
from services.slab.cell.dictionary import ANGLES_RAD
from services.slab.results.result import SlabFit

COSINES = 20_001
"""Number of nodes of the table, at equal steps of the cosine: at the forward peak they are then 0.6 degrees apart, less
than the dictionary's 0.9."""
EDGE_TO_WIDTH = 10.0
"""Lateral size of the scene's slab, in widths of the cell."""

SCENE = """<scene version="3.0.0">
  <!-- {width_mm:g} mm of the material at {wavelength_nm:g} nm; lengths are millimetres. -->
  <integrator type="volpath"><integer name="max_depth" value="256"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="0, 0, {distance_mm:g}" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/></film>
  </sensor>
  <emitter type="constant"/>
  <shape type="cube">
    <transform name="to_world"><scale x="{edge_mm:g}" y="{edge_mm:g}" z="{half_mm:g}"/></transform>
    {bsdf}
    <medium name="interior" type="homogeneous">
      <spectrum name="sigma_t" value="{sigma_t:.9g}"/>
      <spectrum name="albedo" value="{albedo:.9g}"/>
      <phase type="tabphase"><string name="values" value="{values}"/></phase>
    </medium>
  </shape>
</scene>
"""


def tabphase_values(phase_per_sr: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values from a cosine of -1, backward, to 1, forward, at equal steps (COSINES,): the order of Mitsuba's plugin.

    Args:
        phase_per_sr: phase function at the dictionary's angles, from 0 to 180 degrees; linear between them.
    """
    angles = np.arccos(np.linspace(-1.0, 1.0, COSINES))
    return np.interp(angles, ANGLES_RAD, phase_per_sr)


def values_text(fit: SlabFit) -> str:
    """The table as the plugin's parameter ``values``."""
    return ", ".join(f"{value:.6g}" for value in tabphase_values(np.array(fit.phase.value_per_sr)))


def scene_xml(fit: SlabFit, cell: Cell) -> str:
    """Scene of a slab of the cell's width before a camera, in even light."""
    parameters = fit.parameters
    bsdf = '<bsdf type="null"/>'
    if cell.boundary == "smooth":
        bsdf = (
            f'<bsdf type="dielectric"><float name="int_ior" value="{parameters.index.value:g}"/><float name="ext_ior"'
            f' value="{cell.index_outside:g}"/></bsdf>'
        )
    edge_mm = EDGE_TO_WIDTH * cell.width_mm / 2
    return SCENE.format(
        width_mm=cell.width_mm,
        wavelength_nm=fit.wavelength_nm,
        distance_mm=4 * edge_mm,
        edge_mm=edge_mm,
        half_mm=cell.width_mm / 2,
        bsdf=bsdf,
        sigma_t=parameters.sigma_t.value,
        albedo=parameters.sigma_s.value / parameters.sigma_t.value,
        values=values_text(fit),
    )
