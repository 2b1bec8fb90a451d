"""Fit of the material in a slab folder, wavelength by wavelength."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import SlabFolder, read_folder
from services.core.store import write_atomic
from services.slab.cell.dictionary import Material
from services.slab.cell.forward import Blocks, render
from services.slab.cell.rig import Rig, rig_of
from services.slab.design.next_measurement import next_measurement
from services.slab.dictionaries.chosen import ChosenDictionary, dictionary_of
from services.slab.dictionaries.through_beam import index_of
from services.slab.options import SlabOptions
from services.slab.read.images import Measurements, read_images
from services.slab.results.atoms import atoms_of
from services.slab.results.notes import is_short_of_paths, notes_of
from services.slab.results.result import (
    Errors,
    SlabFit,
    Wavelength,
    image_error,
    is_unlike,
    parameters_of,
    phase_of,
    with_believable_flags,
)
from services.slab.solve.budget import Budget
from services.slab.solve.checkpoint import Checkpoints
from services.slab.solve.gauss_newton import GaussNewton
from services.slab.solve.normal import Each
from services.slab.solve.start import start
from services.slab.solve.uncertainty import uncertainty_of

STEPS_OF_ATOMS = 20
"""Largest number of steps of a search by the weights of atoms: narrow lobes are noisy and their steps damped, and a
start that was 30 % off took 11."""
FINAL_RENDER = 2**30
"""Number of the render from which image errors are taken, apart from those of the solver."""


def fit_slab(root: Path, options: SlabOptions | None = None, blocks: Blocks = map) -> tuple[SlabFit, ...]:
    """Fit every wavelength of a folder.

    Args:
        blocks: function that runs blocks of paths; ``map`` runs them in this process, one after the other.

    Raises:
        CaptureInputError: the folder cannot be read.
    """
    options = options or SlabOptions()
    folder = read_folder(root)
    images = [(wavelength, read_images(root, folder, wavelength)) for wavelength in folder.wavelengths_nm]
    return tuple(
        fit_images(folder, wavelength, measured, options, blocks, dictionary_of(root, folder, wavelength, options)).fit
        for wavelength, measured in images
    )


def fit_images(
    folder: SlabFolder,
    wavelength_nm: float,
    measured: Measurements,
    options: SlabOptions,
    blocks: Blocks,
    dictionary: ChosenDictionary,
    checkpoints: Checkpoints | None = None,
    each: Each = map,
) -> Wavelength:
    """Fit the images of one wavelength by the dictionary that the options name; see ``fit_slab``.

    Args:
        checkpoints: state from which an interrupted fit continues, and which is stored before each of the
            last steps.
        each: function that computes with batch after batch in this process, such as that of a pool of threads.
    """
    begun_s = time.process_time()
    index = index_of(folder, wavelength_nm)
    rig = rig_of(folder, wavelength_nm, index.value)
    solver = GaussNewton(
        rig,
        measured,
        options.seed,
        _budget(options, dictionary),
        blocks,
        dictionary.coordinates,
        checkpoints=checkpoints,
        each=each,
    )
    solution = solver.solve(lambda: start(rig, measured, options.seed, blocks))
    material, uncertainty = solution.material, uncertainty_of(solution)
    first, second = final_renders(rig, material, solver.budget, options.seed, blocks)
    errors = _errors(measured, first, second)
    parameters = parameters_of(material, uncertainty, index, rig.width_mm)
    phase = phase_of(material, uncertainty, rig.width_mm)
    notes = notes_of(rig, options.dictionary, measured, solution, parameters, phase, errors, (first, second))
    # Nothing is worth measuring next for a material whose images these are not, or while more paths would help.
    if not dictionary.names and not is_unlike(errors) and not is_short_of_paths(solution):
        advice = next_measurement(
            folder, wavelength_nm, index.value, measured, material, solution.scale, options.seed, blocks
        )
        notes += (advice,) if advice else ()
    fit = SlabFit(
        wavelength_nm=wavelength_nm,
        parameters=parameters,
        phase=phase,
        errors=errors,
        notes=notes,
        converged=solution.converged,
        steps=solution.steps,
        paths=solution.paths,
        core_seconds=time.process_time() - begun_s,
        dictionary=options.dictionary,
        atoms=atoms_of(dictionary, material, uncertainty),
    )
    shape = len(measured.values), rig.grid.rows, rig.grid.columns
    measured_images = np.where(np.isfinite(measured.variances), measured.values, np.nan).reshape(shape)
    fit = with_believable_flags(fit)
    return Wavelength(
        fit,
        measured_images,
        (0.5 * (first + second)).reshape(shape),
        measured.held_out,
        measured.names,
        uncertainty.averaging,
    )


def _budget(options: SlabOptions, dictionary: ChosenDictionary) -> Budget:
    plain = Budget(max_steps=STEPS_OF_ATOMS) if dictionary.names else Budget()
    return plain.scaled(options.effort)


def final_renders(rig: Rig, material: Material, budget: Budget, seed: int, blocks: Blocks) -> NDArray[np.float64]:
    """Two independent renders of the fit's final material (2, images, pixels)."""
    return render(
        rig, material, seed=seed, step=FINAL_RENDER, batches=2, paths=budget.final_paths, scores=False, blocks=blocks
    ).images


def _errors(measured: Measurements, first: NDArray[np.float64], second: NDArray[np.float64]) -> Errors:
    """Errors of the images that were fitted, and of those that were held out."""
    fitted, held_out = (
        image_error(*(image[chosen] for image in (first, second, measured.values, measured.variances)))
        if chosen.any()
        else None
        for chosen in (~measured.held_out, measured.held_out)
    )
    assert fitted is not None
    if held_out is None:
        return Errors(fit_error=fitted.value, fit_error_se=fitted.se, held_out_error=None)
    return Errors(
        fit_error=fitted.value, fit_error_se=fitted.se, held_out_error=held_out.value, held_out_error_se=held_out.se
    )


def write_results(fits: tuple[SlabFit, ...], out: Path) -> None:
    """Write ``parameters.json``, ``phase.json`` and ``errors.json``, by wavelength."""
    out.mkdir(parents=True, exist_ok=True)
    for name in ("parameters", "phase", "errors"):
        content = {f"{fit.wavelength_nm:g}": getattr(fit, name).model_dump() for fit in fits}
        if name == "parameters":
            for fit in fits:
                content[f"{fit.wavelength_nm:g}"] |= {atom: one.model_dump() for atom, one in fit.atoms.items()}
        if name == "errors":
            for fit in fits:
                content[f"{fit.wavelength_nm:g}"] |= {"notes": fit.notes}
        write_atomic(out / f"{name}.json", json.dumps(content, indent=1).encode())
