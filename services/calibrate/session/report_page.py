"""Report of a calibration: one HTML file that needs no other file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from services.calibrate.session.boards import describe_model
from services.calibrate.session.drawings import (
    ARROW_PX,
    MAX_SHARE,
    chart_drawing,
    corners_drawing,
    lights_drawing,
    srgb,
    uncertainty_drawing,
)
from services.calibrate.session.record import REFLECTANCE_SE
from services.calibrate.session.run import Session
from services.core.calibration.record import Calibration
from services.core.pages.page import page_template
from services.core.store import write_atomic

REPORT = "report.html"


def write_report(session: Session, out: Path) -> None:
    """Write ``report.html`` into a folder."""
    template = page_template(Path(__file__).parent / "report.html.j2")
    judgement = session.judgement
    broken = len(judgement.broken)
    page = template.render(
        made=session.record.made,
        days=f"{session.record.valid_days:g}",
        verdict="All limits are kept." if not broken else f"{broken} of {len(judgement.limits)} limits are not kept.",
        is_broken=broken > 0,
        advice=judgement.advice,
        suspicions=judgement.suspicions,
        limits=judgement.limits,
        arrow=f"{ARROW_PX:g}",
        channels=", ".join(session.record.channels),
        cameras=[_camera(session, number) for number in range(len(session.cameras.names))],
        lights=_lights(session),
        colours=_colours(session),
        between=None if session.colours is None else session.colours.between_cameras,
        assumed=list(_assumed(session)),
    )
    write_atomic(out / REPORT, page.encode())


def _markup(drawing: str) -> Any:
    from markupsafe import Markup

    return Markup(drawing)  # noqa: S704 - drawn from numbers, names escaped


def _camera(session: Session, number: int) -> dict[str, Any]:
    fit, name = session.cameras.fit, session.cameras.names[number]
    mine = fit.corners.camera == number
    drawing, largest = uncertainty_drawing(fit, number, session.cameras.distance_mm)
    size = fit.rig.lenses[number].size
    posed, se = session.posed_cameras[number], _standard_errors(session.record)
    values = posed.lens.values[:4].tolist()
    intrinsics = {
        key: f"{value:.2f} ± {_known(unit * se.get(f'camera.{name}.{key}', np.nan), MAX_SHARE * size[0])}"
        for key, value, unit in zip(("fx", "fy", "cx", "cy"), values, (values[0], values[1], 1.0, 1.0), strict=True)
    }
    return {
        **intrinsics,
        "name": name,
        "model": describe_model(session.cameras.choices[name]),
        "centre": ", ".join(f"{x:.1f}" for x in posed.centre_mm),
        "turned": _rms(se, f"camera.{name}", ("rx", "ry", "rz"), np.degrees(1), "°"),
        "moved": _rms(se, f"camera.{name}", ("tx", "ty", "tz"), 1.0, " mm"),
        "corners": int(mine.sum()),
        "left_out": int((mine & ~fit.inliers).sum()),
        "sigma": f"{fit.sigma_px[number]:.3f}",
        "residuals": _markup(corners_drawing(fit, number)),
        "uncertainty": _markup(drawing),
        "largest": f"{largest:.3f} px" if largest else "not known",
    }


def _known(error: float, largest: float) -> str:
    """Return a standard error in words; one above the largest that says anything is not known."""
    return f"{error:.2f}" if error < largest else "not known"


def _standard_errors(record: Calibration) -> dict[str, float]:
    """Return the standard errors that a record states, by name."""
    stated = record.uncertainty
    return {} if stated is None else dict(zip(stated.names, np.sqrt(np.diag(stated.matrix)).tolist(), strict=True))


def _rms(se: Mapping[str, float], of: str, parts: tuple[str, ...], factor: float, unit: str) -> str:
    """Return the rms of three standard errors with its unit."""
    values = [se.get(f"{of}.{part}", np.nan) for part in parts]
    rms = factor * float(np.sqrt(np.mean(np.square(values))))
    return f"{rms:.2g}{unit}" if np.isfinite(rms) else "not known"


def _lights(session: Session) -> dict[str, Any] | None:
    record = session.record
    if not record.lights:
        return None
    se = _standard_errors(record)
    errors = np.array(
        [np.linalg.norm([se.get(f"light.{light.name}.{x}", np.nan) for x in "xyz"]) for light in record.lights]
    )
    where = np.array([light.position_mm for light in record.lights])
    cameras = np.array([camera.centre_mm for camera in session.posed_cameras])
    names = [light.name for light in record.lights]
    rows = [
        {
            "name": light.name,
            "where": ", ".join(f"{x:.1f}" for x in light.position_mm),
            "error": f"{error:.2f} mm" if np.isfinite(error) else "not known",
            "intensity": ", ".join(
                f"{x:.4f}"
                + (f" ± {100 * gain:.2f} %" if (gain := se.get(f"light_gain.{light.name}.{channel}")) else "")
                for x, channel in zip(light.intensity, record.channels, strict=True)
            ),
        }
        for light, error in zip(record.lights, errors, strict=True)
    ]
    sentences = []
    if session.lights is not None:
        fit = session.lights.fit
        sentences.append(
            f"Highlights scatter by {fit.highlight_sigma_px:.3f} px and outlines by {fit.outline_sigma_px:.3f} px about"
            " the fit."
        )
    if session.intensity is not None:
        scatter = ", ".join(f"{100 * one:.2f} %" for one in session.intensity.fit.sigma)
        sentences.append(f"Photographs of white spheres scatter by {scatter} about the fit.")
    drawing = lights_drawing(where, names, cameras, errors if np.isfinite(errors).all() else None)
    return {"drawing": _markup(drawing), "rows": rows, "summary": " ".join(sentences)}


def _colours(session: Session) -> list[dict[str, Any]]:
    step = session.colours
    if step is None:
        return []
    rows = []
    for name, fit in step.fits.items():
        rgb = step.rgb[name]
        drawing = chart_drawing(srgb(step.xyz), rgb, srgb(fit.xyz(np.nan_to_num(rgb))))
        models = ", ".join(f"{model} {value:.2f}" for model, value in fit.held_out_by_model.items())
        sentence = f"ΔE2000 of patches that were left out, mean by model: {models}."
        rows.append({"name": name, "drawing": _markup(drawing), "summary": sentence})
    return rows


def _assumed(session: Session) -> Iterator[str]:
    yield "Counts are linear in light above black."
    for camera in session.record.cameras:
        if camera.vignetting is None:
            yield f"Camera {camera.name} has no flat frame: light is taken to be even over its image."
    if session.lights is None:
        yield (
            "No mirror sphere was photographed: lights stand where raw.toml lists them, in the frame of the first"
            " board."
        )
    if session.intensity is None:
        yield "No white sphere was photographed: all lights count as equally bright."
    elif session.intensity.fit.exponent == 0:
        yield "Lights shine alike in all directions: the white spheres' places tell of no lobe."
    if session.intensity is not None and session.intensity.reflectance_se is None:
        yield (
            f"The white sphere's reflectance is right to {100 * REFLECTANCE_SE:g} %, as raw.toml gives no"
            " reflectance_se: so well is the gain of all photographs known."
        )
    if session.colours is not None:
        yield "Light on the chart is even, also in the image; its white is that of its grey patches."
