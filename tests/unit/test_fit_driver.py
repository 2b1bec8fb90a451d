"""What the driver takes from the uncertainty for its report."""

from __future__ import annotations

import numpy as np

from services.anatomy.blend import dentin_blend_shape
from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.covariance import Uncertainty
from services.fit.stages.tooth.driver import shape_covariance
from services.phantom.dome_rig import dome_cameras
from services.transport.thickness import fitted_thickness


def known(*names: str) -> Uncertainty:
    count = len(names)
    covariance = np.arange(count**2, dtype=np.float64).reshape(count, count)
    return Uncertainty(
        Domain(tuple(Coordinate((name,)) for name in names)),
        np.zeros(count),
        covariance,
        np.zeros((count, 0)),
        np.eye(count),
    )


def test_the_blend_weights_covariance_is_cut_out_of_the_whole() -> None:
    assert shape_covariance(known("enamel.sigma", "shape.0", "dentin.sigma", "shape.1")) == ((5.0, 7.0), (13.0, 15.0))
    assert shape_covariance(known("enamel.sigma", "dentin.sigma")) == ()


def test_thickness_has_an_error_only_where_the_dentin_was_fitted() -> None:
    incisor = build_incisor()
    (camera,) = dome_cameras(1, 1.0, (incisor.outer,))
    given = fitted_thickness(incisor.outer, DentinShape.known(incisor.dentin), (), (), camera)
    assert given is not None
    assert given.mean.se is None
    covariance = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    spread = fitted_thickness(incisor.outer, dentin_blend_shape(incisor.outer), (0.5, 0.5, 0.5), covariance, camera)
    assert spread is not None
    assert spread.mean.se is not None
    # Independent weights of 0.1 move the mean by some hundredths of a millimetre, and each point's by at least as much
    # in the root mean square.
    assert 0.005 < spread.mean.se < 0.1
    assert spread.errors_mm is not None
    assert np.sqrt(np.nanmean(spread.errors_mm**2)) >= spread.mean.se
    assert fitted_thickness(incisor.outer, None, (), (), camera) is None
