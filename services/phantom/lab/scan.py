"""Scan of a phantom jaw as a scanner gives it: one open labelled surface with noise, cut off above the gums' base."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.scan import LabelledScan
from services.anatomy.scans.separation import separate
from services.anatomy.templates.jaw import Jaw
from services.core.geometry import Mesh, Tooth

BELOW_CERVIX_MM = 4.0
"""Distance below the mean cervical line to which the scan shows the gums, mm."""


def scan_of(jaw: Jaw, noise_mm: float = 0.02, seed: int = 0, teeth_a_side: int = 7) -> LabelledScan:
    """Scan a phantom jaw, in the jaw's frame.

    Args:
        jaw: the phantom.
        noise_mm: standard deviation of each coordinate.
        seed: seed of the noise.
        teeth_a_side: number of teeth on each side of the midline that are scanned; the scan ends behind them.
    """
    surfaces = separate(tuple(Tooth(tooth.fdi, tooth.outer) for tooth in jaw.teeth), jaw.gums)
    cervix = float(
        np.mean(
            [tooth.frame.world_from_canonical(np.array([[0.0, 0.0, tooth.cervix_mm]]))[0, 2] for tooth in jaw.teeth]
        )
    )
    parts = [(mesh, tooth.fdi) for mesh, tooth in zip(surfaces.crowns, jaw.teeth, strict=True)] + [(surfaces.gums, 0)]
    first = np.cumsum([0, *(len(mesh.vertices_mm) for mesh, _ in parts)])
    vertices = np.concatenate([mesh.vertices_mm for mesh, _ in parts])
    faces = np.concatenate([mesh.faces + start for (mesh, _), start in zip(parts, first, strict=False)])
    labels = np.repeat([label for _, label in parts], [len(mesh.faces) for mesh, _ in parts])
    # Join equal vertices; this works because the surfaces share their cut edges bit for bit.
    joined, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces].astype(np.int32)
    kept = joined[faces][..., 2].min(axis=1) > cervix - BELOW_CERVIX_MM
    middles = {tooth.fdi: tooth.outer.vertices_mm.mean(axis=0) for tooth in jaw.teeth}
    if teeth_a_side < 7:
        # End the scan midway to the next tooth, and leave out all teeth behind.
        behind = np.mean([middles[10 * quadrant + teeth_a_side + k][1] for quadrant in (1, 2) for k in (0, 1)])
        near = joined[faces].mean(axis=1)[:, 1] > behind
        kept &= near & ((labels == 0) | (labels % 10 <= teeth_a_side))
    joined = joined + np.random.default_rng(seed).normal(0, noise_mm, joined.shape)
    return LabelledScan(Mesh(joined, faces[kept]), labels[kept])


def write_labelled_ply(path: Path, mesh: Mesh, labels: NDArray[np.int64]) -> None:
    """Write a text PLY with the property ``label`` of each face."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices_mm)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "property int label"]
    lines += ["end_header", *(" ".join(map(repr, row)) for row in mesh.vertices_mm.tolist())]
    lines += [f"3 {a} {b} {c} {label}" for (a, b, c), label in zip(mesh.faces.tolist(), labels.tolist(), strict=True)]
    path.write_text("\n".join(lines) + "\n")
