"""Roots for scanned crowns: an open crown is closed to a solid by a tapering root, or a stub of one, at its cervical
line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.patches import (
    boundary_loops,
    compact,
    fill_holes,
    harmonic_rows,
    manifold_piece,
    neighbours,
    ring_faces,
    vector_area_mm2,
)
from services.anatomy.templates.average_arch import is_upper
from services.anatomy.templates.dimensions import root_length_mm
from services.core.errors import MeshError
from services.core.geometry import Mesh

STUB_MM = 4.0
"""Length of a root stub beyond the cervical line's most apical point, mm; deeper parts in the gums are not seen."""
TAPER = 0.72
"""Ratio of the stub's width at its end to that of the cervical line."""
ROUNDING_MM = 1.2
"""Height of the root's rounded end, which is part of its length, mm."""
WHOLE_TAPER, MOLAR_TAPER = 0.35, 0.5
"""Ratio of a whole root's width at its end to that of the cervical line, for single roots and for molars: a single root
ends in a blunt point, the roots of a molar stand apart."""
WHOLE_NARROWING = 1.5
"""Exponent by which a whole root narrows with depth. Roots stay nearly as wide as the neck for some millimetres and are
conical further on: half way down they have 0.77 of its width."""
FIRST_MOLAR = 6
"""Place of the first molar from the midline."""
ROW_MM = 0.45
"""Distance between rows of vertices, mm."""
WIDEST_BRIDGE_MM = 3.5
"""Largest distance between the two sides of a contact, mm; sides farther apart are a tooth's front and back."""
STEEP_NOTCH = 0.5
"""Ratio of depth to width above which the rise of the cervical line between two teeth is taken for a contact."""
HARMONICS = 3
"""Number of harmonics of the closed curve that is the root's last cross-section."""


@dataclass(frozen=True)
class Root:
    """Form of an assumed root; its cross-section narrows from the cervical line to the end."""

    length_mm: float = STUB_MM
    """Length beyond the cervical line's most apical point."""
    taper: float = TAPER
    """Ratio of the width at the end, before rounding, to that of the cervical line."""
    rounding_mm: float = ROUNDING_MM
    """Height of the rounded end, which is part of the length."""
    narrowing: float = 1.0
    """Exponent of the narrowing with depth; above 1 the root narrows slowly below the neck and more towards the end."""


STUB = Root()


def whole_root(fdi: int) -> Root:
    """Root of average length for the tooth's kind; the roots of a molar are replaced by one of their common width."""
    position = fdi % 10
    taper = MOLAR_TAPER if position >= FIRST_MOLAR else WHOLE_TAPER
    return Root(root_length_mm(position, is_upper=is_upper(fdi)), taper, narrowing=WHOLE_NARROWING)


def close_crown(crown: Mesh, occlusal: NDArray[np.float64], name: str, root: Root = STUB) -> Mesh:
    """Close a crown by a root to a watertight solid, whose surface outside the gums is the crown's own triangles.

    Args:
        crown: open surface. All but its largest manifold piece is dropped: specks, and faces at edges with more than
            two faces.
        occlusal: unit vector (3,) along the tooth's axis, out of the gums.
        name: name of the tooth for errors.
        root: form of the root.

    Raises:
        MeshError: the crown is closed, or not cut off by its cervical line across the axis.
    """
    crown = compact(Mesh(crown.vertices_mm, crown.faces[manifold_piece(crown)]))
    if not boundary_loops(crown.faces):
        raise MeshError(
            f"The crown of {name} has no open edge at its neck; give the scanned crown alone, or use the solid as"
            " it is."
        )
    crown, _ = fill_holes(_without_spikes(crown))
    if vector_area_mm2(crown) @ occlusal <= 0:
        raise MeshError(
            f"The crown of {name} is open towards its cusps or inside out; check its label and the orientation of its"
            " triangles."
        )

    crown = _bridge_contacts(crown, occlusal)
    loop = boundary_loops(crown.faces)[0]
    rows, pole = _stub_rows(crown.vertices_mm[loop], occlusal, root)
    first, around = len(crown.vertices_mm), len(loop)
    ring = np.concatenate([loop[None], first + np.arange(len(rows) * around).reshape(len(rows), around)])
    vertices = np.concatenate([crown.vertices_mm, rows.reshape(-1, 3), pole[None]])
    cap = np.stack([np.roll(ring[-1], -1), ring[-1], np.full(around, len(vertices) - 1)], axis=-1)
    solid = Mesh(vertices, np.concatenate([crown.faces, ring_faces(ring, vertices), cap]).astype(np.int32))
    solid.require_solid(f"of {name}, closed by a root,")
    return solid


def _without_spikes(crown: Mesh, rounds: int = 4) -> Mesh:
    # Remove triangles that are connected by one edge only, and smooth the steps that they leave in the boundary.
    for _ in range(rounds):
        spiked = np.count_nonzero(neighbours(crown.faces) < 0, axis=1) > 1
        crown = Mesh(crown.vertices_mm, crown.faces[~spiked])
        crown = compact(Mesh(crown.vertices_mm, crown.faces[manifold_piece(crown)]))
    vertices = crown.vertices_mm.copy()
    for _ in range(rounds):
        for loop in boundary_loops(crown.faces):
            vertices[loop] = vertices[loop] / 2 + (vertices[np.roll(loop, 1)] + vertices[np.roll(loop, -1)]) / 4
    return Mesh(vertices, crown.faces)


def _bridge_contacts(crown: Mesh, occlusal: NDArray[np.float64]) -> Mesh:
    # Join the two sides of each notch by a strip. Where teeth touch, the scan shows the wall of neither, and the
    # cervical line rises to the contact.
    for apex in _notches(crown, occlusal):
        loop = boundary_loops(crown.faces)[0]
        loop = np.roll(loop, -int(np.linalg.norm(crown.vertices_mm[loop] - apex, axis=1).argmin()))
        position = crown.vertices_mm[loop]
        height = position @ occlusal
        edges = set(map(tuple, np.sort(crown.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).tolist()))
        before, after, strip, whole = 0, 0, [], 0
        while after - before < len(loop) // 2:
            # Choose the shorter of the two next chords.
            steps = [(before - 1, after), (before, after + 1)] if before or after else [(-1, 1)]
            steps = [(i, j) for i, j in steps if tuple(sorted((int(loop[i]), int(loop[j])))) not in edges]
            chord, i, j = min(
                ((float(np.linalg.norm(position[i] - position[j])), i, j) for i, j in steps), default=(np.inf, 0, 0)
            )
            if chord > WIDEST_BRIDGE_MM:
                break
            strip.append((loop[j], loop[after] if j > after else loop[before], loop[i]))
            before, after = i, j
            if height[0] - (height[i] + height[j]) / 2 > STEEP_NOTCH * chord:
                whole = len(strip)
        if whole:
            crown = _with_strip(crown, np.array(strip[:whole]))
    return crown


def _notches(crown: Mesh, occlusal: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    # Highest points (3,) of the cervical line on both sides of the tooth.
    loop = crown.vertices_mm[boundary_loops(crown.faces)[0]]
    height = loop @ occlusal
    first = int(height.argmax())
    ahead = (np.arange(len(loop)) - first) % len(loop)
    opposite = (ahead > len(loop) // 4) & (ahead < 3 * len(loop) // 4)
    return [loop[first], loop[int(np.where(opposite, height, -np.inf).argmax())]]


def _with_strip(crown: Mesh, strip: NDArray[np.int64]) -> Mesh:
    # Add the strip; its last chord gets vertices as dense as those of the cervical line.
    j, k, i = strip[-1]
    start, end = crown.vertices_mm[i], crown.vertices_mm[j]
    pieces = max(1, round(float(np.linalg.norm(end - start)) / ROW_MM))
    between = start + np.linspace(0, 1, pieces + 1)[1:-1, None] * (end - start)
    chord = np.array([i, *(len(crown.vertices_mm) + np.arange(pieces - 1)), j])
    fan = np.stack([chord[1:], np.full(pieces, k), chord[:-1]], axis=1)
    return Mesh(
        np.concatenate([crown.vertices_mm, between]), np.concatenate([crown.faces, strip[:-1], fan]).astype(np.int32)
    )


def _stub_rows(
    loop_mm: NDArray[np.float64], occlusal: NDArray[np.float64], root: Root
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Rows (R, N, 3) of the root and its pole (3,): columns run from the cervical line to a smooth ring across the axis,
    # and then over a rounded end to the pole.
    height = loop_mm @ occlusal
    flat = loop_mm - np.outer(height, occlusal)
    centre = flat.mean(axis=0)
    end = centre + root.taper * _smooth_ring(flat - centre, occlusal)
    end_height = height.min() - root.length_mm + root.rounding_mm

    steps = max(4, int(np.ceil((height.mean() - end_height) / ROW_MM)))
    wall = harmonic_rows(loop_mm, end + end_height * occlusal, steps)
    depth = np.arange(1, len(wall) + 1) / len(wall)
    wider = (1 - (1 - root.taper) * depth**root.narrowing) / (1 - (1 - root.taper) * depth)
    across = wall - centre - (wall @ occlusal)[..., None] * occlusal
    wall = wall + (wider - 1)[:, None, None] * across
    bends = np.linspace(0, np.pi / 2, max(3, int(np.ceil(2 * root.rounding_mm / ROW_MM))) + 1)[1:-1]
    lid = np.stack(
        [
            centre + np.cos(bend) * (end - centre) + (end_height - root.rounding_mm * np.sin(bend)) * occlusal
            for bend in bends
        ]
    )
    return np.concatenate([wall, lid]), centre + (end_height - root.rounding_mm) * occlusal


def _smooth_ring(offsets_mm: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    # Ring (N, 3) of the curve's lowest Fourier descriptors; an ellipse if a ring with more descriptors is not convex.
    across = np.linalg.svd(axis[None])[2][1:]
    across[1] = np.cross(axis, across[0])
    spectrum = np.fft.fft(offsets_mm @ across[0] + 1j * (offsets_mm @ across[1]))
    order = np.abs(np.fft.fftfreq(len(spectrum), 1 / len(spectrum)))
    for harmonics in (HARMONICS, 1):
        ring = np.fft.ifft(np.where((order <= harmonics) & (order > 0), spectrum, 0))
        edge = np.roll(ring, -1) - ring
        turn = np.angle(np.roll(edge, -1) / edge)
        # Accept a ring that is convex and turns once around.
        if (turn * np.sign(turn.sum()) > 0).all() and abs(abs(turn.sum()) - 2 * np.pi) < 1e-6:
            break
    return np.outer(ring.real, across[0]) + np.outer(ring.imag, across[1])
