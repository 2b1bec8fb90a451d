"""What is said where the dentin reaches out of its tooth."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from services.core.errors import MeshError
from services.core.geometry import Mesh
from services.transport.scene.nesting import require_nested


def test_the_move_that_is_asked_for_suffices() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32)
    outer, dentin = Mesh(4.0 * vertices, faces), Mesh(3.0 * vertices + [2.77, 0.0, 0.0], faces)
    with pytest.raises(MeshError, match=r"1\.77 mm beyond it; see .*, and move the dentin by 1\.77 mm inwards"):
        require_nested(outer, dentin, 0.00014)
