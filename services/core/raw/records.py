"""``raw.toml``: the photographs of a laboratory, as its cameras wrote them. Lengths mm, times s, angles degrees.

Pixel centres lie at half-integers. Counts above black are linear in light unless a series of exposures measures their
non-linearity.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import Field, model_validator

from services.core.calibration.cameras_and_lights import is_absent
from services.core.consent import Consent, Subject
from services.core.geometry import Record, Vector3
from services.core.raw.targets import Board, CalibrationFile, Chart, Label, Landmark, Pixel, RawName, ScanFile, Sphere
from services.core.records import FileName
from services.core.values import Number, Positive, Unit, Whole

Mosaic = Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"]
FrameKind = Literal[
    "black", "tracking", "light", "flat", "dark-room", "board", "mirror-sphere", "white-sphere", "chart"
]
TARGET_KEYS: Mapping[str, str] = MappingProxyType(
    {"board": "board", "mirror-sphere": "sphere", "white-sphere": "sphere", "chart": "chart"}
)
"""Kind of frame that shows a board, sphere or chart -> key of the frame that names it."""
LIT_BY_ONE = frozenset({"light", "mirror-sphere", "white-sphere"})
"""Kinds of frame that are taken under one light at a time."""
DARK = frozenset({"black", "dark-room"})
"""Kinds of frame for which the dome is off: black frames see no light at all, dark-room frames the light of the
room."""
MOSAIC_CHANNELS = ("red", "green", "blue")
MAX_BITS = 16


class RawCamera(Record):
    """A camera, and the format of its files."""

    name: RawName
    size: tuple[Annotated[Whole, Field(gt=0, le=65536)], Annotated[Whole, Field(gt=0, le=65536)]] = Field(
        description="width, height in pixels"
    )
    bits: Annotated[Whole, Field(ge=1, le=MAX_BITS)] | None = Field(
        default=None, description="significant bits of a count; needed wherever files hold whole numbers"
    )
    shift: Annotated[Whole, Field(ge=0, lt=MAX_BITS)] = Field(
        default=0, description="how many bits the files move counts up: 4 for 12 bits in the high bits of 16"
    )
    mosaic: Mosaic = Field(default="none", description="colours of the 2 x 2 pixels at the upper left, row by row")
    channels: tuple[RawName, ...] = Field(
        default=MOSAIC_CHANNELS, min_length=1, max_length=16, description="order in the files where mosaic is none"
    )
    saturation_counts: Positive | None = Field(
        default=None, description="counts from which on a pixel is taken for full; default: the largest of its bits"
    )
    serial: str | None = None

    @property
    def full_counts(self) -> float | None:
        """Counts from which on a pixel is saturated; None where neither bits nor saturation_counts are given."""
        if self.saturation_counts is not None:
            return self.saturation_counts
        return None if self.bits is None else float(2**self.bits - 1)

    @model_validator(mode="after")
    def _require_consistent_bits(self) -> RawCamera:
        if self.bits is not None and self.bits + self.shift > MAX_BITS:
            raise ValueError(f"bits = {self.bits} and shift = {self.shift} go beyond the {MAX_BITS} bits of a file")
        if self.bits is not None and self.saturation_counts is not None and self.saturation_counts > 2**self.bits - 1:
            raise ValueError(
                f"saturation_counts = {self.saturation_counts:g} is more than {self.bits} bits hold"
                f" ({2**self.bits - 1})"
            )
        if twice := _repeated(self.channels):
            raise ValueError(f"channel {twice} is listed twice")
        if self.mosaic != "none" and self.channels != MOSAIC_CHANNELS:
            raise ValueError(f"a mosaic has the channels {', '.join(MOSAIC_CHANNELS)}; leave channels out")
        return self


class RawLight(Record):
    """A light of the rig."""

    name: RawName
    address: Whole | None = Field(default=None, ge=0, description="at the dome's controller")
    position_mm: Vector3 | None = Field(
        default=None, description="a guess or a measured list in any one frame: it is aligned rigidly"
    )
    group: Label | None = None


class RawFrame(Record):
    """One photograph of one camera."""

    camera: RawName
    file: FileName = Field(min_length=1, description="relative to raw.toml")
    kind: FrameKind
    light: RawName | None = Field(default=None, description="null: all lights on, or none where the kind is a dark one")
    level: Unit = Field(default=1.0, description="of the lights, as a fraction of full; their intensity scales with it")
    exposure_s: Positive
    gain: Positive = Field(default=1.0, description="linear factor from light to counts, beside the exposure")
    time_s: Number | None = Field(default=None, description="since the capture began")
    session: Label | None = None
    place: Label | None = Field(
        default=None, description="frames of one kind and place see the thing unmoved, from all cameras"
    )
    board: RawName | None = None
    sphere: RawName | None = None
    chart: RawName | None = None
    corners_px: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        default=None, description="of a chart: centres of its patches 1, 6, 24, 19; searched where it is null"
    )

    @property
    def target(self) -> str | None:
        """Name of the board, sphere or chart that the frame shows; None for other kinds."""
        return self.board or self.sphere or self.chart

    @property
    def label(self) -> str:
        """The frame's camera and light, or its kind, in words for a message."""
        shown = f"light {self.light}" if self.light is not None else self.kind
        return f"camera {self.camera}, {shown}"

    @model_validator(mode="after")
    def _require_fields_of_its_kind(self) -> RawFrame:
        for key in ("board", "sphere", "chart"):
            is_required = TARGET_KEYS.get(self.kind) == key
            if is_required and getattr(self, key) is None:
                raise ValueError(f"a frame of kind {self.kind} must name its {key}")
            if not is_required and getattr(self, key) is not None:
                raise ValueError(f"a frame of kind {self.kind} has no {key}; leave it out")
        if self.kind in LIT_BY_ONE and self.light is None:
            raise ValueError(f"a frame of kind {self.kind} must name its light")
        if self.kind in {*DARK, "tracking"} and self.light is not None:
            lit = "all lights on" if self.kind == "tracking" else "no light on"
            raise ValueError(f"a frame of kind {self.kind} has {lit}; leave light out")
        if self.kind not in DARK and self.level == 0:
            raise ValueError(f"a frame of kind {self.kind} needs a level above 0")
        if self.corners_px is not None and self.kind != "chart":
            raise ValueError(f"a frame of kind {self.kind} has no corners_px; leave them out")
        return self


class RawFolder(Record):
    """The content of ``raw.toml``. Names are unique, and frames and landmarks name only things that are listed."""

    units: Literal["mm"]
    calibration: CalibrationFile | None = None
    camera: Annotated[tuple[RawCamera, ...], Field(min_length=1, max_length=1000)]
    light: Annotated[tuple[RawLight, ...], Field(max_length=1000)] = ()
    frame: Annotated[tuple[RawFrame, ...], Field(min_length=1, max_length=100_000)]
    board: tuple[Board, ...] = ()
    sphere: tuple[Sphere, ...] = ()
    chart: tuple[Chart, ...] = ()
    scan: ScanFile | None = None
    landmark: tuple[Landmark, ...] = ()
    subject: Subject | None = Field(default=None, exclude_if=is_absent)
    consent: Consent | None = Field(default=None, exclude_if=is_absent)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the capture, in the order of its first camera."""
        return self.camera[0].channels

    def camera_named(self, name: str) -> RawCamera:
        """The camera of that name, which must be listed."""
        return next(camera for camera in self.camera if camera.name == name)

    def frames_of(self, camera: str, kind: FrameKind) -> tuple[RawFrame, ...]:
        """Frames of one camera and one kind, in the order of the file."""
        return tuple(frame for frame in self.frame if frame.camera == camera and frame.kind == kind)

    @model_validator(mode="after")
    def _names_agree(self) -> RawFolder:
        for what in ("camera", "light", "board", "sphere", "chart"):
            if twice := _repeated(one.name for one in getattr(self, what)):
                raise ValueError(f"{what} {twice} is listed twice; give each {what} a name of its own")
        for camera in self.camera:
            if set(camera.channels) != set(self.channels):
                ours, theirs = ", ".join(camera.channels), ", ".join(self.channels)
                raise ValueError(
                    f"camera {camera.name} has channels {ours}, but {self.camera[0].name} has {theirs}; all need the"
                    " same"
                )
        self._require_known()
        if twice := _repeated(frame.file for frame in self.frame):
            raise ValueError(f"file {twice} is listed in two frames; keep one of them")
        return self

    def _require_known(self) -> None:
        known = {
            what: {one.name for one in getattr(self, what)} for what in ("camera", "light", "board", "sphere", "chart")
        }
        kinds = {sphere.name: sphere.kind for sphere in self.sphere}
        for frame in self.frame:
            for what, names in known.items():
                if (name := getattr(frame, what)) is not None and name not in names:
                    listed = ", ".join(sorted(names)) or "none"
                    raise ValueError(
                        f"frame {frame.file} names {what} {name}, which is not listed; listed are {listed}"
                    )
            if frame.sphere is not None and frame.kind != f"{kinds[frame.sphere]}-sphere":
                raise ValueError(
                    f"frame {frame.file} is of kind {frame.kind}, but sphere {frame.sphere} is {kinds[frame.sphere]}"
                )
        for sphere in self.sphere:
            if sphere.reflectance is not None and len(sphere.reflectance) != len(self.channels):
                raise ValueError(
                    f"sphere {sphere.name} has {len(sphere.reflectance)} reflectances for {len(self.channels)} channels"
                )
        for landmark in self.landmark:
            for click in landmark.pixels:
                if click.camera not in known["camera"]:
                    raise ValueError(
                        f"landmark {landmark.tooth} {landmark.point} names camera {click.camera}, which is not listed"
                    )
            if twice := _repeated(click.camera for click in landmark.pixels):
                raise ValueError(f"landmark {landmark.tooth} {landmark.point} names camera {twice} twice")
        if twice := _repeated(f"{landmark.tooth} {landmark.point}" for landmark in self.landmark):
            raise ValueError(f"landmark {twice} is listed twice; keep one of them")


def _repeated(names: Iterable[str]) -> str | None:
    return min((name for name, count in Counter(names).items() if count > 1), default=None)
