"""Records that cross a process boundary: a job's options, and the description of a folder capture."""

from __future__ import annotations

from enum import IntFlag
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints, WithJsonSchema, model_validator
from pydantic_core import PydanticCustomError

from services.core.calibration.cameras_and_lights import CameraColour, is_absent
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.consent import Consent, Subject
from services.core.files.store_url import StoreUrl
from services.core.geometry import Camera, Light, Name, Record
from services.core.job_kinds import JOB_KINDS, foreign_options, known_kind
from services.core.light.safety import (
    SHIPPED_LIGHT_LIMIT_S,
    SHIPPED_TOTAL_LIMIT_S,
    AssessmentOfLights,
    DoseOfAllLights,
    DoseOfOneLight,
    FlashAcknowledgement,
)
from services.core.pages.object_words import PARTS
from services.core.slab.dictionaries import DEFAULT_DICTIONARY, DICTIONARIES, known_dictionary, require_particles
from services.core.surface.rough import FIT, MultipleScattering, Roughness, require_rough_job
from services.core.values import AUTO, Number, PixelStep, Positive, Unit, Whole

JobName = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=80, pattern=r"^[^\x00-\x1f\x7f]*$")
]
"""A label that a person gives a job: one line, as long as a list of jobs can show."""
Device = Literal["llvm", "cuda"]
Boundary = Literal["matched", "thin", "rough"]
KindName = Annotated[str, AfterValidator(known_kind), WithJsonSchema({"type": "string", "enum": list(JOB_KINDS)})]
"""Name of a kind of job: one of ``JOB_KINDS``, or of an installed package."""
DictionaryName = Annotated[
    str, AfterValidator(known_dictionary), WithJsonSchema({"type": "string", "enum": list(DICTIONARIES)})
]
"""Name of an entry of ``DICTIONARIES``."""
Loss = Literal["l2", "relative_l2", "l1", "relative_l1", "robust"]
Priority = Literal["low", "normal", "high"]
Motion = Literal["auto", "tracking", "off"]


class MaskBit(IntFlag):
    """Why a pixel is not used; 0 means valid. Stored as uint16 in ``prepared.zarr/valid``."""

    OUTSIDE = 1
    HIGHLIGHT = 2
    SATURATED = 4
    MOTION = 8
    SHADOW = 16
    NOT_FINITE = 32
    MANUAL = 64
    UNLIT = 128


def _no_nul(value: str) -> str:
    if "\0" in value:
        raise PydanticCustomError("path", "no path holds the character NUL")
    return value


FileName = Annotated[str, AfterValidator(_no_nul)]
"""Path of a file below a capture's folder."""


class ImageEntry(Record):
    """One image of a folder capture."""

    camera: str
    light: str
    file: FileName
    variance_file: FileName | None = None
    held_out: bool = False


class FolderCapture(Record):
    """``capture.json`` of a folder capture, also the description of a rig (then ``images`` may be empty)."""

    units: Literal["mm"]
    channels: tuple[Name, ...] = Field(fail_fast=True)
    cameras: tuple[Camera, ...] = Field(fail_fast=True)
    lights: tuple[Light, ...] = Field(fail_fast=True)
    images: tuple[ImageEntry, ...] = Field(default=(), fail_fast=True)
    uncertainty: CalibrationUncertainty | None = Field(
        default=None, description="how wrong the calibration may be; null where that was not measured"
    )
    colour: dict[str, CameraColour] | None = Field(
        default=None, exclude_if=is_absent, description="colours of each camera by its name; they apply to the asset"
    )
    subject: Subject | None = Field(
        default=None, exclude_if=is_absent, description="pseudonymous label of the person; never a name"
    )
    consent: Consent | None = Field(
        default=None, exclude_if=is_absent, description="for which uses and until when the person agreed"
    )


class SimulatedCameraSpec(Record):
    """What the simulated cameras add to the virtual mouth they look at."""

    bits: Literal[8, 10, 12, 14, 16] = Field(default=12, description="analogue-to-digital resolution")
    black_level: Whole = Field(default=64, description="counts without light")
    noise_relative: Unit = Field(default=0.01, description="noise, fraction of the value")
    noise_floor: Unit = Field(default=0.002, description="noise, fraction of full scale")
    motion_px: Number = Field(
        default=0.0, ge=0, description="largest displacement of the subject between frames, pixels"
    )
    seed: Whole = 0


SIMULATED_DOME = "simulated"
"""Value in place of a dome's address: a simulated dome on loopback is started for the capture; no real light is lit."""
MAX_ON_TIME_S = 60.0
"""Longest time, s, for which a light may be on without a break: the controller's strobe counts 65.5 s in its 16 bits,
and 2 s of them are its margin."""
DEMO_MOUTH = Path("demo")
"""Value in place of a rig's mouth that the job makes itself: its first stage renders a virtual incisor, so that a
demonstration needs no file anywhere."""


class RigSpec(Record):
    """Which dome and cameras to capture with."""

    dome: str = Field(
        default=SIMULATED_DOME,
        description="host:port of the Modbus controller, or 'simulated' to start one on loopback",
    )
    cameras: Literal["simulated", "playback"] = "simulated"
    mouth: Path = Field(
        description=(
            "folder capture: the rig's calibration and meshes; for simulated cameras also the images they see. "
            "'demo' has a virtual incisor rendered first"
        )
    )
    level: Unit = Field(default=0.5, description="LED level, fraction of full scale")
    exposure_s: Positive = Field(default=0.05, description="exposure time")
    settle_s: Number = Field(default=0.002, ge=0, description="wait between light on and exposure")
    tracking_every: Whole = Field(
        default=6, ge=0, description="an all-on tracking frame every so many lights; 0 for none"
    )
    black_frames: Whole = Field(default=2, ge=1, description="frames without light")
    watchdog_s: Number = Field(
        default=2.0, gt=0, le=60, description="the dome goes dark by itself when not fed for this long"
    )
    light_exposure_limit_s: DoseOfOneLight[Positive] = SHIPPED_LIGHT_LIMIT_S
    total_exposure_limit_s: DoseOfAllLights[Positive] = SHIPPED_TOTAL_LIMIT_S
    assessment: AssessmentOfLights = None
    flashes: FlashAcknowledgement | None = Field(
        default=None,
        description=(
            "acknowledgement of more than three flashes a second: per_s, eye_cover, epilepsy_asked, by, at; not needed"
            " where the dome is simulated"
        ),
    )
    simulation: SimulatedCameraSpec = SimulatedCameraSpec()

    @property
    def is_simulated(self) -> bool:
        """Whether the dome is a simulated one, so that no real light is lit."""
        return self.dome == SIMULATED_DOME


LOWERED_LIMITS = frozenset({"watchdog_s", "light_exposure_limit_s", "total_exposure_limit_s"})
"""Limits of a rig that a server lowers to its own."""
LIMITS_OF_A_RIG = LOWERED_LIMITS | {"dome", "assessment", "flashes"}
"""Options of a rig that change no frame: the address of its dome, its safety limits, and what those are based on."""
HELD_RANGES = MappingProxyType(
    {"sigma": (0.0, 1000.0), "alpha": (0.0, 1.0), "beta": (0.0, 1.0), "g1": (-1.0, 1.0), "g2": (-1.0, 1.0)}
)
"""Parameter -> open interval of the values that ``JobSpec.held`` may give it; sigma in 1/mm."""

MAX_HELD = 1000
"""Largest number of parameters that a job may hold: more than any model has."""
JOB_FILE = "job.json"
"""Name of the file in a job's folder that holds its options."""


class JobSpec(Record):
    """One job, as in JOB.toml and in POST /v1/jobs. Every option appears here with its default, unit and help."""

    kind: KindName = Field(
        default="tooth",
        description="what is measured: " + "; ".join(f"{name}: {kind.summary}" for name, kind in JOB_KINDS.items()),
    )
    capture: Path | None = Field(default=None, description="folder capture or capture store to fit; give this or [rig]")
    rig: RigSpec | None = Field(default=None, description="rig to capture with; give this or capture")
    calibration: Path | None = Field(
        default=None,
        description="file with cameras and lights that stand in for the capture's own, or calibrations/<name>",
    )
    accept_calibration: bool = Field(
        default=False, description="use a calibration also where it is beyond the limits that it was held to"
    )
    fdi: Whole | None = Field(
        default=None,
        ge=11,
        le=85,
        description=("of kind tooth: the tooth to fit, by its FDI number, where the capture has several"),
    )
    surroundings: Literal["auto", "on", "off"] = Field(
        default="auto",
        description=(
            "of kind tooth: render light that passes between the tooth, gums and other teeth, which are taken to have"
            " the tooth's media; auto: where they come from a registered scan"
        ),
    )
    boundary: Boundary = Field(default="thin", description="model of the surface of enamel, or of an object")
    ior: Number = Field(
        default=1.631, ge=1, le=3, description="index of refraction of enamel or object, unused by boundary = matched"
    )
    roughness: Roughness = FIT
    multiple_scattering: MultipleScattering = "on"
    dentin: Literal["known", "fit", "none"] = Field(
        default="fit",
        description="dentin surface: given by the capture, fitted as blend shape (in a jaw an average one), or absent",
    )
    held: dict[str, float] = Field(
        default={},
        max_length=MAX_HELD,
        description=(
            "parameters that are known and not fitted, such as {'enamel.sigma' = 4.5}; of an object, of body and core"
        ),
    )
    instrument: Literal["on", "off"] = Field(
        default="on",
        description=(
            "of all kinds but slab and calibration: fit the instrument's errors too (gain, lights, flare), within the"
            " calibration's ±"
        ),
    )
    loss: Loss = Field(
        default="l2", description="what is minimised; robust gives less weight to outliers such as shadow borders"
    )
    solver: Literal["gauss-newton", "adam"] = Field(
        default="gauss-newton", description="adam: as in teeth 2018, hundreds of gradients at constant samples"
    )
    adam_steps: Whole = Field(default=300, ge=1, le=100_000, description="most steps of solver = adam in each stage")
    adam_rate: Positive = Field(
        default=0.05, description="learning rate of solver = adam, in lengths over which images are about linear"
    )
    prior: Literal["weak", "literature"] = Field(
        default="weak", description="literature: media are drawn towards measured teeth where the images say little"
    )
    stains: bool = Field(default=False, description="fit a texture of stains on the enamel after the media")
    lobes: Literal[1, 2] = Field(default=1, description="Henyey-Greenstein lobes per medium")
    held_out_lights: tuple[str, ...] | None = Field(
        default=None,
        fail_fast=True,
        description="lights kept from the fit; default: the capture's own, else every fourth",
    )
    held_out_cameras: tuple[str, ...] = Field(
        default=(),
        fail_fast=True,
        description="cameras kept from the fit, under all lights; the others then lose those of held_out_lights alone",
    )
    left_out_lights: tuple[str, ...] = Field(
        default=(),
        fail_fast=True,
        description="lights whose images are not used at all, such as one that a report calls far off",
    )
    channels: tuple[str, ...] | None = Field(default=None, fail_fast=True, description="channels to fit; default: all")
    seed: Whole = Field(default=1, ge=0, le=2**31 - 1, description="random seed; the same job gives the same answer")
    highlights: bool = Field(
        default=True,
        description=(
            "leave out pixels where the surface reflects a light; false for photographs through crossed polarisers"
        ),
    )
    shadows: bool = Field(
        default=False,
        description=(
            "leave out pixels that a camera's other lights show to lie in the shadow of lips, retractor or a hand"
        ),
    )
    motion: Motion = Field(
        default="auto",
        description=(
            "how the subject's motion is found: by tracking frames, or auto, which takes the outline of the teeth under"
            " each light where there are fewer than two; off for what cannot move, such as an extracted tooth"
        ),
    )
    memory_gib: Number = Field(
        default=2.0,
        ge=0.5,
        le=1024,
        description=(
            "most memory, GiB, that a worker takes to prepare a raw folder's images: "
            "its photographs are worked on in strips as high as that allows"
        ),
    )
    store: StoreUrl | None = Field(
        default=None,
        description="s3://BUCKET/PREFIX below which the prepared images are kept in place of the job's folder; "
        "endpoint, region and credentials are those of the workers' environment (AWS_ENDPOINT_URL, AWS_REGION, "
        "AWS_ACCESS_KEY_ID, …)",
    )
    pixel_step: PixelStep = Field(
        default=AUTO,
        description=(
            "fit means over squares of n x n pixels; auto: the largest whose edge at the teeth is at most 0.5 mm, and"
            " single pixels where stains are fitted"
        ),
    )
    samples_per_pixel: Whole = Field(
        default=64, ge=2, le=65536, description="paths per pixel and pass at the start; raised as the fit needs"
    )
    max_samples_per_pixel: Whole = Field(default=1024, ge=2, le=65536, description="most paths per pixel and pass")
    max_steps: Whole = Field(default=12, ge=1, le=200, description="most Gauss-Newton steps")
    image_tolerance: Number = Field(
        default=0.004,
        ge=0.0001,
        le=0.1,
        description=(
            "a fit has converged when what noise leaves open of its parameters changes the images by no more, "
            "as a fraction; a smaller one goes on to smaller standard errors, as far as max_samples_per_pixel allows"
        ),
    )
    search_candidates: Whole = Field(default=50_000, ge=100, description="table-search points per channel")
    advise: bool = Field(default=True, description="say at the end which further light or view would help most")
    sensor_noise_relative: Unit = Field(
        default=0.01, description="assumed noise where the capture gives no variance, fraction of the value"
    )
    sensor_noise_floor: Unit = Field(default=0.002, description="assumed noise, fraction of the image maximum")
    effort: Number = Field(
        default=1.0,
        ge=0.01,
        le=100,
        description="of kind slab: paths, in units of the default budget; ± shrink as its root",
    )
    dictionary: DictionaryName = Field(
        default=DEFAULT_DICTIONARY,
        description="of kind slab: what the phase function is built from; "
        + "; ".join(f"{name}: {one.summary}" for name, one in DICTIONARIES.items()),
    )
    particle_index: Number | None = Field(
        default=None, ge=0.1, le=10, description="of dictionary mie: the particles' index of refraction, real part"
    )
    particle_absorption: Number = Field(
        default=0.0, ge=0, le=10, description="of dictionary mie: imaginary part of the particles' index"
    )
    workers: Whole = Field(default=2, ge=1, le=1024, description="processes of a local run")
    device: Device = Field(
        default="llvm", description="where paths are traced: the processor, or a CUDA device of every worker"
    )
    priority: Priority = Field(
        default="normal",
        description="which waiting jobs start first; of running fits each takes four times the share of a lower one",
    )

    @property
    def is_demo(self) -> bool:
        """Whether the job begins by making the mouth that it captures."""
        return self.rig is not None and self.rig.mouth == DEMO_MOUTH

    @property
    def changed_options(self) -> frozenset[str]:
        """Names of the options whose value differs from their default."""
        fields = JobSpec.model_fields.items()
        return frozenset(name for name, field in fields if getattr(self, name) != field.get_default())

    @model_validator(mode="after")
    def _options_of_its_kind(self) -> JobSpec:
        # A stored job holds every field, so an option counts as given where its value differs from the default.
        if foreign := sorted(foreign_options(self.kind, self.changed_options)):
            own = sorted(JobSpec.model_fields.keys() - foreign_options(self.kind, frozenset(JobSpec.model_fields)))
            raise ValueError(f"a job of kind {self.kind} has no option '{foreign[0]}'; it has {', '.join(own)}")
        return self

    @model_validator(mode="after")
    def _particles_and_surface(self) -> JobSpec:
        require_particles(self.dictionary, self.particle_index, self.particle_absorption)
        if self.boundary == "rough":
            require_rough_job(self.kind, self.ior, self.roughness, stains=self.stains)
        return self

    @model_validator(mode="after")
    def _one_source(self) -> JobSpec:
        if (self.capture is None) == (self.rig is None):
            raise ValueError("give exactly one of 'capture' (a folder) and '[rig]'")
        if self.max_samples_per_pixel < self.samples_per_pixel:
            raise ValueError("max_samples_per_pixel must be at least samples_per_pixel")
        for name, value in self.held.items():
            part, _, leaf = name.partition(".")
            outer, inner = PARTS.values() if self.kind == "object" else PARTS
            if part not in {outer, inner} or leaf not in HELD_RANGES:
                raise ValueError(
                    f"held names '{name}'; it can hold {', '.join(HELD_RANGES)} of {outer} and {inner}, such as"
                    f" {outer}.sigma"
                )
            low, high = HELD_RANGES[leaf]
            if not low < value < high:
                raise ValueError(f"held {name} = {value:g} must lie between {low:g} and {high:g}")
        return self
