"""The bodies of an asset: closed regions of one medium each, in three channels. It needs NumPy only."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

TOOTH_IOR, GUMS_IOR = 1.631, 1.33
"""Refractive indices of enamel, where the asset names none, and of the gums."""
THIN_ABSORPTION, THIN_ALPHA = 0.3, 0.12
"""What glass makes of a thin boundary, as in the asset's scene_dielectric.xml: the factor on the media's absorption,
because glass sends back 0.67 of diffuse light from inside and the thin boundary 0.11, and the Beckmann width of its
facets, as GGX's lose 8 % of the light there."""
WELD_MM = 1e-5
"""Length by which two vertices at the same place may differ, mm."""
TOOTH_PARTS, OBJECT_PARTS, OBJECT = ("enamel", "dentin"), ("body", "core"), "object"
"""Outer and inner part of a tooth, and of an object, whose folder has this name."""


class SceneError(RuntimeError):
    """The asset or the request does not make a scene; the message says what to do."""


@dataclass(frozen=True)
class Surface:
    """Triangles: vertices (V, 3) in mm, faces (F, 3), and u, v of the faces' corners (F, 3, 2), with v upwards."""

    vertices: np.ndarray
    faces: np.ndarray
    corners_uv: np.ndarray

    def turned(self) -> Surface:
        """The same surface seen from its other side."""
        return Surface(self.vertices, self.faces[:, ::-1], self.corners_uv[:, ::-1])

    def welded(self) -> Surface:
        """The surface with one vertex at each place; surfaces that were cut apart differ there by their rounding."""
        _, first, index = np.unique(np.round(self.vertices / WELD_MM), axis=0, return_index=True, return_inverse=True)
        return Surface(self.vertices[first], index.reshape(-1)[self.faces], self.corners_uv)

    def moved_inwards(self, distance_mm: float) -> Surface:
        """The surface with each vertex moved against its normal, the mean of its faces' normals by area."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.faces[:, k], np.cross(b - a, c - a))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return Surface(self.vertices - distance_mm * normals, self.faces, self.corners_uv)


def read_ply(path: Path) -> Surface:
    """Read the triangles of a binary PLY file."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}
    counts: dict[str, int] = {}
    columns: list[tuple[str, str]] = []
    element = ""
    for line in head.decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", element, count]:
                counts[element] = int(count)
            case ["property", "list", count, index, _]:
                face = np.dtype([("count", kinds[count]), ("corners", kinds[index], 3)])
            case ["property", kind, name] if element == "vertex":
                columns.append((name, kinds[kind]))
    points = np.frombuffer(body, np.dtype(columns), counts["vertex"])
    corners = np.frombuffer(body, face, counts["face"], offset=points.nbytes)["corners"].astype(np.int64)
    names = [name for name, _ in columns]
    u, v = (points[name].astype(float) if name in names else np.zeros(len(points)) for name in "uv")
    # The asset's first row of texels lies at v = 0, Blender's at v = 1.
    uv = np.stack([u, 1 - v], axis=1)[corners]
    return Surface(np.stack([points[axis] for axis in "xyz"], axis=1).astype(float), corners, uv).welded()


@dataclass(frozen=True)
class Medium:
    """A scattering medium: extinction per mm, albedo, weight of the first lobe, and the lobes' mean cosines; (3,)."""

    sigma: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    g1: np.ndarray
    g2: np.ndarray

    @property
    def lobes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Scattering coefficient per mm and mean cosine of each lobe that scatters."""
        first, second = (weight * self.sigma * self.alpha for weight in (self.beta, 1 - self.beta))
        return [(first, self.g1)] + ([(second, self.g2)] if second.any() else [])

    @property
    def absorption(self) -> np.ndarray:
        """Absorption coefficient per mm."""
        return np.asarray(self.sigma * (1 - self.alpha))

    def absorbing(self, factor: float) -> Medium:
        """The medium with so many times its absorption, and its scattering as it is."""
        scattering = self.sigma * self.alpha
        sigma = scattering + factor * self.absorption
        alpha = np.divide(scattering, sigma, out=np.array(self.alpha, dtype=float), where=sigma > 0)
        return replace(self, sigma=sigma, alpha=alpha)

    @property
    def scattering_reduced(self) -> np.ndarray:
        """Reduced scattering coefficient per mm."""
        return np.asarray(np.sum([scattering * (1 - g) for scattering, g in self.lobes], axis=0))


@dataclass(frozen=True)
class Side:
    """Part of a body's surface."""

    surface: Surface
    ior: float = 1.0
    """Refractive index of the body relative to what lies beyond; 1 where light passes as if there were no surface."""
    outside: bool = False
    """Whether air lies beyond."""


@dataclass(frozen=True)
class Body:
    """Region of one medium."""

    name: str
    medium: Medium
    sides: list[Side]
    moved: bool
    """Whether its surface is moved inwards, away from that of the body that touches it."""
    stains: list[Path | None] = field(default_factory=list)
    """Pictures of the share of light that stains absorb, for each of three channels."""

    def surface(self) -> Surface:
        """The whole surface, closed, with the faces in the order of the sides."""
        surfaces = [side.surface for side in self.sides]
        starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
        return Surface(
            np.concatenate([surface.vertices for surface in surfaces]),
            np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]),
            np.concatenate([surface.corners_uv for surface in surfaces]),
        ).welded()


class Asset:
    """The numbers and surfaces of an asset's folder, in three channels."""

    def __init__(self, folder: Path, channels: Sequence[str] = ()) -> None:
        self.folder = folder
        self.rig, self.parameters = (
            json.loads((folder / f"{name}.json").read_text()) for name in ("rig", "parameters")
        )
        known = self.rig["channels"]
        named = list(channels) or ([c for c in ("red", "green", "blue") if c in known] or known)[:3]
        if unknown := [name for name in named if name not in known]:
            raise SceneError(f"The asset has no channel {unknown[0]}; it has {', '.join(known)}.")
        self.channels = (named + named[-1:] * 2)[:3]
        """The channels that are shown as red, green and blue; the last stands for those that are missing."""

    def intensity(self, light: str) -> np.ndarray:
        """Radiant intensity (3,) of a light, with mm as the length unit."""
        values = dict(zip(self.rig["channels"], self.rig["lights"][light]["intensity"], strict=True))
        return np.array([values[channel] for channel in self.channels])

    def values(self, name: str, unset: float) -> np.ndarray:
        """A parameter's values (3,), or ``unset`` where it was not modelled."""
        tables = [self.parameters[channel] for channel in self.channels]
        return np.array([table[name]["value"] if name in table else unset for table in tables], dtype=float)

    def medium(self, part: str) -> Medium:
        """The medium of ``enamel``, ``11.dentin`` or ``gums``; an empty one where it was not modelled."""
        unset = {"sigma": 0.0, "alpha": 0.0, "beta": 1.0, "g1": 0.0, "g2": 0.0}
        return Medium(*(self.values(f"{part}.{name}", value) for name, value in unset.items()))

    def as_glass(self, surface: str) -> bool:
        """Whether a surface of glass stands for the thin boundary of the fit."""
        return surface == "glass" and self.rig["boundary"] == "thin"

    def finish(self, surface: str, roughness: float | None) -> tuple[str, float, str]:
        """Surface, roughness and distribution of its facets, as Cycles names them, by options that go before the asset.

        A rough boundary is glass. Cycles' roughness is the root of GGX's alpha, and its MULTI_GGX gives back the light
        that meets several facets. Glass in place of a thin boundary is rough as in the asset's scene_dielectric.xml.
        """
        if self.as_glass(surface):
            return surface, THIN_ALPHA**0.5 if roughness is None else roughness, "BECKMANN"
        if surface != "asset" or self.rig["boundary"] != "rough":
            return surface, roughness or 0.0, "GGX"
        own = self.rig["roughness"] ** 0.5 if roughness is None else roughness
        return "glass", own, "MULTI_GGX" if self.rig["multiple_scattering"] else "GGX"

    @property
    def one_phase(self) -> bool:
        """Whether every lobe has the same mean cosine in all channels."""
        return all(np.ptp(g) == 0 for body in self.bodies() for _, g in body.medium.lobes)

    def bodies(self) -> list[Body]:
        """The bodies of a tooth, of a mouth or of an object."""
        outers = sorted([*self.folder.glob("teeth/*/outer.ply"), *self.folder.glob("object/outer.ply")])
        if not outers:
            raise SceneError(
                f"{self.folder} has neither teeth/<number>/outer.ply nor object/outer.ply; put the script into an"
                " asset's folder."
            )
        matched = self.rig["boundary"] == "matched"
        ior, gums_ior = (1.0, 1.0) if matched else (self.rig.get("ior", TOOTH_IOR), GUMS_IOR)
        # A mouth's surfaces are cut along each other, and each of two bodies that touch has the surface between them.
        cut = {path.stem: read_ply(path) for path in sorted(self.folder.glob("surfaces/*.ply"))}
        found, flesh = [], [Side(cut["gums"], gums_ior, True)] if "gums" in cut else []
        for path in outers:
            number, prefix = path.parent.name, f"{path.parent.name}." if cut else ""
            outer, inner = OBJECT_PARTS if number == OBJECT else TOOTH_PARTS
            stem = number if number == OBJECT else f"tooth_{number}"
            shell = [] if cut else [Side(read_ply(path), ior, True)]
            for name, surface in cut.items():
                kind, *owners = name.split("_")
                if number not in owners:
                    continue
                if kind == "crown":
                    shell.append(Side(surface, ior, True))
                elif kind == "root":
                    shell.append(Side(surface, ior / gums_ior))
                    flesh.append(Side(surface.turned()))
                elif kind == "contact":
                    shell.append(Side(surface if owners[0] == number else surface.turned()))
            if path.with_name(f"{inner}.ply").is_file():
                core = read_ply(path.with_name(f"{inner}.ply"))
                shell.append(Side(core.turned()))
                found.append(Body(f"{stem}_{inner}", self.medium(f"{prefix}{inner}"), [Side(core)], moved=not cut))
            files = [path.with_name(f"stain_{channel}.png") for channel in self.channels]
            stains = [file if file.is_file() else None for file in files]
            found.append(Body(f"{stem}_{outer}", self.medium(f"{prefix}{outer}"), shell, bool(cut), stains))
        return found + ([Body("gums", self.medium("gums"), flesh, moved=False)] if flesh else [])

    def solids(self) -> list[Body]:
        """Teeth and objects as outer surfaces of one medium, the dentin's or core's where there is any; gums as they
        are.
        """
        found = self.bodies()
        media, solids = {body.name: body.medium for body in found}, [body for body in found if body.name == "gums"]
        for body in found:
            stem, _, part = body.name.rpartition("_")
            for outer, inner in (TOOTH_PARTS, OBJECT_PARTS):
                if part == outer:
                    folder = self.folder / (stem if stem == OBJECT else stem.replace("tooth_", "teeth/"))
                    side = Side(read_ply(folder / "outer.ply"), outside=True)
                    solids.append(Body(stem, media.get(f"{stem}_{inner}", body.medium), [side], moved=False))
        return solids
