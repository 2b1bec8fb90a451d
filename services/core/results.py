"""Records that stages publish: the manifests of capture and preparation, and a fit's results: estimates with their
standard errors, the report, the verdict and the exported asset.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.core.calibration.cameras_and_lights import CameraColour, is_absent
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.geometry import Camera, Light, Record, Vector3
from services.core.light.safety import FlashAcknowledgement
from services.core.records import FolderCapture
from services.core.values import Positive, Unit


class Estimate(Record):
    """A number with its unit and uncertainty. Undetermined numbers are flagged, never bare."""

    value: float
    se: float | None = Field(description="one standard error; null where the parameter was not fitted")
    unit: str = Field(description="'1' for dimensionless")
    determined: bool = Field(description="whether the data fixes this number")
    se_parts: dict[str, float] = Field(
        default={},
        description=(
            "what the standard error is made of, largest first; the squares add up to its square. photographs: their"
            " noise; rendering: that of renders; gain, light_gain, flare, teeth, dome: the calibration's; shift: that"
            " of the photographs' motion; prior: that of media and shapes; mean_cosine: one that is held; shape: the"
            " dentin's, as far as it is held or no blend shape follows it; unfinished: the step that was left"
        ),
    )


class ToothReport(Record):
    """One tooth of a jaw."""

    state: Literal["fitted", "tied", "failed"] = Field(
        description="from its own pixels; held near other teeth for lack of them; or its own fit raised"
    )
    sentence: str = Field(description="why it is tied or failed, or what is wrong with it; may be empty")
    told: str = Field(default="", description="in plain words, what the capture tells of it and what it cannot")
    pixels: int = Field(description="pixels that show it and enter the fit, over all views")
    parameters: dict[str, dict[str, Estimate]] = Field(description="per channel, as in FitReport")
    fit_error: dict[str, float] = Field(description="per channel, on its pixels; absent where none was fitted")
    held_out_error: dict[str, float] = Field(description="per channel, on its pixels")
    shape: tuple[float, ...] = Field(
        default=(), description="dentin's blend weights, all channels alike; empty where the dentin is known or absent"
    )
    enamel_thickness: Estimate | None = Field(
        default=None,
        description="mean over what the first camera sees of the tooth; null if nothing, or without dentin",
    )


class Correlation(Record):
    """Correlations between the errors of a fit's coordinates, each between -1 and 1."""

    names: tuple[str, ...] = Field(
        description="coordinates of the fit, such as enamel.sigma; alpha stands for -log10(1 - alpha)"
    )
    matrix: tuple[tuple[float, ...], ...]


class Highlights(Record):
    """What the highlights of photographs tell of a surface, beside its roughness."""

    photographs: int = Field(description="photographs whose highlights were fitted")
    lights: int = Field(description="number of their lights")
    pixels: int = Field(description="number of their pixels")
    brightness: float = Field(description="of the highlights, over what index and calibration predict")
    brightness_se: float
    index: float = Field(
        description="index of refraction by this brightness, if the lights' calibration is exact; a gain of the lights"
        " and the index cannot be told apart"
    )
    index_se: float
    surface_height_mm: float = Field(
        description="standard deviation of the scanned surface's smooth error, as the highlights show it"
    )
    warnings: tuple[str, ...] = Field(description="what to know before trusting the roughness, one sentence each")


class RoughSurface(Record):
    """The rough dielectric surface that a fit has held."""

    roughness: Estimate = Field(description="GGX roughness; without a standard error where the job gave it")
    ior: float = Field(description="index of refraction")
    multiple_scattering: bool = Field(description="whether light that meets several facets was given back")
    highlights: Highlights | None = Field(
        default=None,
        exclude_if=is_absent,
        description="what its roughness was measured by; null where the job gave it",
    )

    def estimates(self) -> dict[str, Estimate]:
        """What a table of estimates says of the surface, by name; ``multiple_scattering`` is 1 where light that meets
        several facets was given back, else 0.
        """
        given = {"ior": self.ior, "multiple_scattering": float(self.multiple_scattering)}
        held = {name: Estimate(value=value, se=None, unit="1", determined=False) for name, value in given.items()}
        return {f"surface.{name}": one for name, one in ({"roughness": self.roughness} | held).items()}


class FitReport(Record):
    """Report of a fit, published by the fit stage, and by export as parameters.json and errors.json."""

    converged: bool
    doubtful: bool = Field(
        default=False, description="whether unseen images are farther off than a model that holds would leave them"
    )
    advice: str = Field(description="what to do when it did not converge, or for a better answer; may be empty")
    parameters: dict[str, dict[str, Estimate]] = Field(
        description="per channel: name -> estimate, derived quantities included"
    )
    fit_error: dict[str, float] = Field(description="per channel: relative image error on fitted images")
    held_out_error: dict[str, float] = Field(description="per channel: relative image error on held-out images")
    fit_error_se: dict[str, float] = Field(
        default={}, description="per channel: standard error of fit_error by the renders' noise"
    )
    held_out_error_se: dict[str, float] = Field(default={}, description="per channel: the same of held_out_error")
    steps: int
    shape: tuple[float, ...] = Field(default=(), description="dentin blend weights, in the order of anatomy's modes")
    shape_covariance: tuple[tuple[float, ...], ...] = Field(
        default=(), description="of the blend weights; empty where they were not fitted"
    )
    enamel_thickness: Estimate | None = Field(
        default=None,
        description="mean over what the first camera sees of the tooth; null if nothing, or without dentin",
    )
    surface: RoughSurface | None = Field(
        default=None, description="of boundary = rough: the surface that was held; null for the others"
    )
    teeth: dict[str, ToothReport] = Field(
        default={}, description="of a jaw by FDI number; parameters then holds gums and cavity alone"
    )
    correlations: dict[str, Correlation] = Field(
        default={}, description="per channel: correlation of the fitted coordinates"
    )
    instrument: dict[str, dict[str, Estimate]] = Field(
        default={},
        description=(
            "per channel: the instrument's errors by name, as the images tell them; empty where it counts as perfect"
        ),
    )
    instrument_prior: dict[str, dict[str, float]] = Field(
        default={}, description="per channel: one standard error of each by the calibration, before the fit"
    )
    assumed: tuple[str, ...] = Field(
        default=(),
        description="the instrument's errors whose size no calibration states, by name; teeth and dome of their moves",
    )
    instrument_faults: dict[str, tuple[str, ...]] = Field(
        default={},
        description=(
            "per channel: the instrument's errors, by name, that the images put down to a fault of the calibration"
        ),
    )
    instrument_told: tuple[str, ...] = Field(
        default=(),
        description="what to know of the instrument, one sentence each: what was assumed, what seems at fault",
    )
    told: str = Field(default="", description="in plain words, what the capture tells of the tooth and what it cannot")
    notes: tuple[str, ...] = Field(default=(), description="what the preparation had to say of the capture")
    next_capture: str = Field(
        default="",
        description=(
            "in plain words, which further light, view or measurement of the instrument would help most; empty where"
            " none was looked for"
        ),
    )
    pixel_step: int = Field(default=1, description="edge of the fitted squares, in pixels of the photographs")
    pixel_edge_mm: float | None = Field(
        default=None, description="edge of the fitted squares at the teeth, median over the cameras"
    )
    seconds: float = Field(description="from the first attempt's start to the end, pauses between attempts included")
    seconds_by_purpose: dict[str, float] = Field(
        default={},
        description="time of the last attempt's tasks by what they were for, summed over workers, the longest first",
    )


class Figure(Record):
    """A relative image error with what rendering leaves open of it."""

    value: float = Field(description="relative image error, 0.05 for 5 %")
    se: float | None = Field(
        description="one standard error by the noise of the renders, and of a slab's images; null where it is not known"
    )


class Verdict(Record):
    """How well a fit went, in the numbers that its report leads with."""

    headline: str = Field(description="one sentence, the worst first")
    converged: bool = Field(description="whether the numbers are those of a fit that ended where it should")
    doubtful: bool = Field(
        default=False,
        description="of a fit that converged: whether the numbers may be farther off than their standard errors",
    )
    is_above_limit: bool = Field(
        description="whether an image error, fitted or held out, of some channel is above the limit"
    )
    limit: float = Field(description="relative image error above which no fit is called converged")
    error_of: Literal["held-out", "fitted"] = Field(
        description="which images the errors are of; fitted ones where none was held out"
    )
    error: Figure = Field(description="mean over the channels")
    channels: dict[str, Figure] = Field(description="by channel")
    enamel_thickness: Estimate | None = Field(
        description="of a single tooth, mean over what the first camera sees; null without dentin and of a jaw"
    )
    steps: int
    advice: str = Field(description="what to do where it did not converge, or for a better answer; may be empty")

    @property
    def held_out_error(self) -> float | None:
        """The error, if it is that of held-out images."""
        return self.error.value if self.error_of == "held-out" else None


class AssetManifest(Record):
    """Published by the export stage."""

    files: tuple[str, ...]
    held_out_error: float | None = Field(
        default=None, description="mean over channels; null where no image was held out, and of a calibration"
    )
    converged: bool = Field(default=True, description="whether the fit behind it did")
    advice: str = Field(default="", description="what to do where it did not")
    verdict: Verdict | None = Field(
        default=None, description="how well the fit went; null where an earlier version exported it"
    )
    centre_mm: Vector3 = (0.0, 0.0, 0.0)


class FrameRecord(Record):
    """One acknowledged frame of a capture; wherever this row is on disk, the frame's image is too."""

    index: int
    kind: Literal["black", "tracking", "light"]
    light: str | None
    exposure_s: Positive
    level: Unit
    time_s: float = Field(description="since the capture began")
    readback: tuple[int, int, int] = Field(
        description="R, G, B register levels read back from the controller; all-on frames give the first light's"
    )


class CaptureManifest(Record):
    """Published by the capture stage: ``capture.zarr`` plus the rig's calibration and meshes."""

    description: FolderCapture = Field(description="cameras, lights, channels; images empty")
    frames: tuple[FrameRecord, ...]
    bits: int
    black_level: int
    radiance_per_count: float = Field(description="scene radiance of one count above black at level 1 and 1 s exposure")
    sensor_noise_relative: float
    sensor_noise_floor: float
    fdi: tuple[int, ...]
    flashes: tuple[FlashAcknowledgement, ...] = Field(
        default=(), description="acknowledgements under which light went on more than three times a second"
    )


class PreparedManifest(Record):
    """Published by the prepare stage: ``prepared.zarr`` with radiance, variance, valid, surface; and ``teeth/``."""

    channels: tuple[str, ...]
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    held_out: tuple[tuple[str, str], ...] = Field(description="(camera, light) pairs the source marks as held out")
    fdi: tuple[int, ...]
    dentin_known: tuple[int, ...] = Field(description="FDI numbers whose dentin surface is given")
    gums: bool = Field(
        default=False,
        description="whether gums are to be fitted: pixels that show them are valid, and gums.ply is there",
    )
    cavity: bool = Field(default=False, description="the same for the wall of the mouth, cavity.ply")
    surroundings: bool = Field(
        default=False,
        description="whether a tooth is to be rendered with gums.ply and the other teeth below teeth/",
    )
    tooth_pixels: tuple[int, ...] = Field(
        default=(), description="valid pixels that show each tooth of fdi, over all images; 0 for a hidden tooth"
    )
    median_motion_px: float | None = Field(description="median displacement removed by stabilisation")
    uncertainty: CalibrationUncertainty | None = Field(
        default=None, description="how wrong the calibration may be; null where the capture does not say"
    )
    colour: dict[str, CameraColour] | None = Field(
        default=None, exclude_if=is_absent, description="colours of each camera by its name; null where none is known"
    )
    masks: str = Field(
        default="", description="digest of the masks by hand that it was prepared with; empty without any"
    )
    notes: tuple[str, ...] = Field(
        default=(), description="what to know of the capture before trusting a fit of it, one sentence each"
    )
    valid_fraction: float
