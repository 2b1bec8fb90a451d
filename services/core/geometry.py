"""Cameras, lights and meshes as records.

Lengths are millimetres, camera axes follow OpenCV (x right, y down, z forward).
"""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, field_validator
from pydantic_core import CoreSchema, PydanticCustomError

from services.core.errors import MeshError
from services.core.files.plain_numbers import with_plain_numbers

Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]
MAX_NAME_BYTES = 64
# Unicode categories: controls, surrogates, and separators of lines and paragraphs
UNWRITABLE = {"Cc", "Cs", "Zl", "Zp"}


def _part_of_a_file_name(name: str) -> str:
    plain = not any(letter in "/\\" or unicodedata.category(letter) in UNWRITABLE for letter in name)
    if plain and name not in {"", ".", ".."} and len(name.encode()) <= MAX_NAME_BYTES:
        return name
    rule = (
        f"a name has 1 to {MAX_NAME_BYTES} bytes, no slash, backslash or control character, and is neither '.' nor '..'"
    )
    raise PydanticCustomError("name", "{rule}", {"rule": rule})


Name = Annotated[str, AfterValidator(_part_of_a_file_name)]
"""Name of a camera, light or channel. It is part of the file names of pictures and previews."""


class Record(BaseModel):
    """Base of every record that crosses a process boundary: frozen, no unknown keys, no NaN, and a number is given as a
    number: neither as a text nor as true or false, which would light at full level for ``"level": true``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)
    numbers_from_text: ClassVar[bool] = False
    """Whether texts such as "5" are numbers, as in the variables of an environment."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type[BaseModel], handler: GetCoreSchemaHandler) -> CoreSchema:
        """Build the validator of the record."""
        schema = handler(source)
        return schema if cls.numbers_from_text else with_plain_numbers(schema, cls)


class Camera(Record):
    """A pinhole camera without distortion."""

    name: Name
    size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] = Field(description="width, height in pixels")
    K: Matrix3 = Field(description="intrinsic matrix, pixels; pixel centres at half-integers")
    camera_from_world: Matrix4 = Field(description="rigid transform, mm, OpenCV axes")

    @field_validator("camera_from_world")
    @classmethod
    def _rigid(cls, value: Matrix4) -> Matrix4:
        rotation = np.asarray(value)[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) or np.linalg.det(rotation) < 0:
            raise ValueError("camera_from_world must be a rotation and a translation; re-export the calibrated pose")
        return value

    def project(self, points_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project world points (N, 3) to pixels (N, 2) and depths (N,) in mm."""
        pose = np.asarray(self.camera_from_world)
        local = points_mm @ pose[:3, :3].T + pose[:3, 3]
        image = local @ np.asarray(self.K).T
        return image[:, :2] / image[:, 2:3], local[:, 2]

    def pixel_mm(self, point_mm: NDArray[np.float64]) -> float:
        """Edge length of a pixel's footprint at a world point (3,), mm."""
        return float(self.project(point_mm[None])[1][0] / self.K[0][0])

    def cropped(self, rows: slice, columns: slice) -> Camera:
        """Camera whose whole image is a window of this one's; the slices have a start and a stop, in pixels."""
        first, second, last = self.K
        K = (
            (first[0], first[1], first[2] - columns.start),
            (second[0], second[1], second[2] - rows.start),
            last,
        )
        return self.model_copy(update={"size": (columns.stop - columns.start, rows.stop - rows.start), "K": K})

    def rays(
        self, x_px: NDArray[np.float64], y_px: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origin (3,) in mm and unit directions (N, 3), in world space, of the rays through pixel coordinates (N,)."""
        pose = np.asarray(self.camera_from_world)
        local = np.stack([x_px, y_px, np.ones_like(x_px)], axis=-1) @ np.linalg.inv(np.asarray(self.K)).T
        directions = local @ pose[:3, :3]
        return -pose[:3, :3].T @ pose[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


class Light(Record):
    """An isotropic point light."""

    name: Name
    position_mm: Vector3
    intensity: tuple[float, ...] = Field(description="radiant intensity per channel, with mm as the length unit")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices (V, 3) float64 in mm, faces (F, 3) int32, counter-clockwise seen from outside."""

    vertices_mm: NDArray[np.float64]
    faces: NDArray[np.int32]
    dropped_vertices: int = field(default=0, compare=False)
    """Number of the file's vertices that no face uses, which were dropped as it was read."""

    def edge_counts(self) -> NDArray[np.int64]:
        """Number of faces that share each undirected edge, (E,)."""
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        # Both numbers in one, because single numbers are sorted ten times as fast as rows.
        numbers: NDArray[np.int64] = (edges[:, 0].astype(np.int64) << 32) | edges[:, 1]
        _, counts = np.unique(numbers, return_counts=True)
        return counts

    def signed_volume_mm3(self) -> float:
        """Volume by the divergence theorem; negative when the mesh is inside out."""
        a, b, c = (self.vertices_mm[self.faces[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def require_surface(self, name: str, extent_mm: tuple[float, float] = (2.0, 200.0)) -> None:
        """Refuse a mesh without faces or without a plausible extent in millimetres; it need not be closed.

        Raises:
            MeshError: the mesh is not finite, without faces, or of an extent that nothing in a mouth has.
        """
        if not np.isfinite(self.vertices_mm).all():
            raise MeshError(
                f"Mesh {name} has {np.count_nonzero(~np.isfinite(self.vertices_mm))} non-finite coordinates; repair and"
                " export it again."
            )
        if len(self.faces) == 0:
            raise MeshError(f"Mesh {name} has no faces; export it again with its triangles.")
        extent = float(np.ptp(self.vertices_mm, axis=0).max())
        if not extent_mm[0] <= extent <= extent_mm[1]:
            raise MeshError(
                f"Mesh {name} is {extent:.4g} units across, outside {extent_mm[0]:g} to {extent_mm[1]:g} mm; vertices"
                " must be in millimetres, so rescale it."
            )

    def shell_count(self) -> int:
        """Number of connected parts of the surface; different parts share no vertex."""
        # Every vertex takes the least label of its faces' vertices, and then the label of the vertex that this label
        # names, until no label changes.
        labels = np.arange(len(self.vertices_mm))
        while True:
            before = labels.copy()
            np.minimum.at(labels, self.faces, labels[self.faces].min(axis=1, keepdims=True))
            labels = labels[labels]
            if (labels == before).all():
                return len(np.unique(labels[self.faces[:, 0]]))

    def require_one_shell(self, name: str) -> None:
        """Refuse a mesh of several connected parts, which may lie inside each other.

        Raises:
            MeshError: the mesh has several; the message says how many.
        """
        if (shells := self.shell_count()) > 1:
            raise MeshError(
                f"Mesh {name} holds {shells} separate shells; join them into one surface, or remove all but the"
                " tooth's."
            )

    def require_solid(self, name: str, extent_mm: tuple[float, float] = (2.0, 100.0)) -> None:
        """Refuse a mesh that cannot bound a medium.

        Raises:
            MeshError: the mesh is open, inside out, not finite, or has an extent that no tooth or jaw has in
                millimetres.
        """
        self.require_surface(name, extent_mm)
        open_edges = int(np.count_nonzero(self.edge_counts() != 2))
        if open_edges:
            raise MeshError(
                f"Mesh {name} is not watertight: {open_edges} edges do not join exactly two faces; close its holes."
            )
        if self.signed_volume_mm3() <= 0:
            raise MeshError(f"Mesh {name} is inside out (negative volume); flip its face orientation.")


OBJECT = 0
"""Number, in place of an FDI number, of an object that is no tooth: its body stands for enamel, its core for dentin."""


@dataclass(frozen=True)
class Tooth:
    """One tooth by FDI number: the enamel's outer surface, and the dentin's where it is known. Or, under the number
    ``OBJECT``, any object: its outer surface, and that of its core where it has one.
    """

    fdi: int
    outer: Mesh
    dentin: Mesh | None = None


def teeth_folder(root: Path, fdi: int) -> Path:
    """Folder of one tooth's meshes in a capture or prepared folder: ``teeth/<FDI>/outer.ply`` and ``dentin.ply``, or
    ``object/outer.ply`` and ``core.ply``.
    """
    return root / "object" if fdi == OBJECT else root / "teeth" / str(fdi)


def inner_file(fdi: int) -> str:
    """Name of the file, in that folder, of the surface inside the outer one."""
    return "core.ply" if fdi == OBJECT else "dentin.ply"
