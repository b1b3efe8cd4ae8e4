"""The local frame: metres east, north and up about an origin, in which models are fitted and lengths are true.

A map projection is no Cartesian frame: in UTM a kilometre is up to 40 cm wrong, north is not the grid's north, and the
earth bends away by 8 cm at a kilometre. So the fit is made in a plane tangent to the ellipsoid, and only results go
to the CRS. Heights are taken as above the ellipsoid here; those above the sea change lengths by 1e-5 at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.georeferencing.crs import Crs, load_pyproj, lon_lat

_OFFSET_STEP_M = 100.0
"""Offsets are whole hundreds of metres, so that they can be read, and typed, and subtracted without rounding."""
_DIFFERENCE_M = 100.0
"""Of the differences that the linear form of the projection is taken from; its rounding is then 1e-11."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalFrame:
    """Metres east, north, up about ``offset_m``.

    Args:
        crs: the projection in metres; None where coordinates are those of a site, in no CRS: they are Cartesian then.
        offset_m: (3,) of the origin, in the CRS; whole hundreds.
    """

    crs: Crs | None
    offset_m: tuple[float, float, float]

    @classmethod
    def about(cls, xyz: FloatArray, crs: Crs | None) -> LocalFrame:
        """About the median of points (N, 3) in the CRS; a frame without any height has the offset 0 upwards."""
        middle = [
            float(np.median(column[np.isfinite(column)])) if np.isfinite(column).any() else 0.0 for column in xyz.T
        ]
        x, y, z = (_OFFSET_STEP_M * round(value / _OFFSET_STEP_M) for value in middle)
        return cls(crs=crs, offset_m=(x, y, z))

    def local_from_crs(self, xyz: FloatArray) -> FloatArray:
        """(N, 3) in the frame, of coordinates in the CRS; NaN heights give NaN upwards."""
        offset = np.array(self.offset_m)
        if self.crs is None:
            return np.asarray(xyz - offset)
        flat = np.isnan(xyz[:, 2])
        heights = np.where(flat, offset[2], xyz[:, 2])
        degrees = lon_lat(xyz, self.crs)
        local = np.column_stack(self._tangent().transform(degrees[:, 0], degrees[:, 1], heights))
        local[flat, 2] = np.nan
        return local

    def crs_from_local(self, local: FloatArray) -> FloatArray:
        """(N, 3) coordinates in the CRS, of points in the frame."""
        if self.crs is None:
            return np.asarray(local + np.array(self.offset_m))
        lon, lat, height = self._tangent().transform(*local.T, direction="INVERSE")
        crs = self.crs.horizontal
        x, y = load_pyproj().Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True).transform(lon, lat)
        return np.column_stack([x, y, height])

    def linear_crs_from_local(self) -> FloatArray:
        """(4, 4) to the CRS less the offset, linear about the origin: scale and convergence of the grid.

        How far it is off grows with the square of the distance: 8 cm in height at a kilometre.
        """
        steps = _DIFFERENCE_M * np.vstack([np.eye(3), -np.eye(3), np.zeros((1, 3))])
        moved = self.crs_from_local(steps) - np.array(self.offset_m)
        matrix = np.eye(4)
        matrix[:3, :3] = ((moved[:3] - moved[3:6]) / (2 * _DIFFERENCE_M)).T
        matrix[:3, 3] = moved[6]
        return matrix

    def _tangent(self) -> Any:
        """From degrees and height to the frame."""
        assert self.crs is not None
        x, y, z = self.offset_m
        ((lon, lat),) = lon_lat(np.array([[x, y]]), self.crs).tolist()
        ellipsoid = self.crs.horizontal.ellipsoid
        assert ellipsoid is not None
        shape = f"+a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r}"
        return load_pyproj().Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f"+step +proj=cart {shape} "
            f"+step +proj=topocentric {shape} +lon_0={lon!r} +lat_0={lat!r} +h_0={z!r}"
        )
