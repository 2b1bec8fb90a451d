"""The standard errors of a registered pose are passed on to all who use its teeth, together with the
calibration's own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from services.core.calibration.uncertainty import TWIST, CalibrationUncertainty
from services.core.raw.registration import REGISTRATION, Registration, with_registration
from services.core.store import write_record

TEETH = tuple(f"teeth.{axis}" for axis in TWIST)


def stated(names: tuple[str, ...], variance: float) -> CalibrationUncertainty:
    return CalibrationUncertainty(names=names, covariance=tuple(map(tuple, (variance * np.eye(len(names))).tolist())))


def test_the_poses_covariance_joins_the_calibrations(tmp_path: Path) -> None:
    calibration = stated(("gain.red", "teeth.tx"), 4e-4)
    assert with_registration(tmp_path, calibration) is calibration
    still = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    record = Registration(
        rig_from_scan=still, centre_mm=(0.0, 0.0, 0.0), uncertainty=stated(TEETH, 1e-4), steps=(), misfit_mm=0.05,
        teeth=(11,), repairs="", inputs={}, pictures=(),
    )  # fmt: skip
    write_record(tmp_path / REGISTRATION, record)
    assert with_registration(tmp_path, None) == record.uncertainty
    joined = with_registration(tmp_path, calibration)
    assert joined is not None
    assert joined.names == ("gain.red", *TEETH)
    np.testing.assert_array_equal(np.diag(joined.matrix), [4e-4] + 6 * [1e-4])
