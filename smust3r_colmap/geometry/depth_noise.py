"""When two depths belong to one surface: the tolerances of all stages.

All are relative, differences over depth. They answer different questions:

=======================  ==================================================  =====  ================================
constant                 question                                            value  used by
=======================  ==================================================  =====  ================================
``VIEW_AGREEMENT``       do the maps of two views show the same surface?     0.02   confirmation of depth, COLMAP's
                                                                                    fusion, transfer of matches
``FULL_VIEW_AGREEMENT``  the same, where agreement is gradual                0.015  plane sweep
``VISIBILITY``           is a point of the scene the surface of a map?       0.03   mesh: texture, truncation
``ADJACENT_PIXELS``      are adjacent pixels of a map one surface?           0.03   interpolation in maps
``WINDOW_PIXELS``        are the pixels of a window of a map one surface?    0.05   normals, planes of patches
``SUBMODEL_AGREEMENT``   do two submodels show the same surface?             0.05   alignment, edges, confidence
=======================  ==================================================  =====  ================================

The first three follow from the noise of a map, the next two from the slant of a surface, and the last from the
distortion of submodels.
"""

from __future__ import annotations

DEPTH_SIGMA = 0.01
"""Typical relative error of the depth of a pixel, such as a plane sweep's."""

VIEW_AGREEMENT = 2 * DEPTH_SIGMA
"""Between the maps of two views at one point, each with its noise."""
FULL_VIEW_AGREEMENT = 1.5 * DEPTH_SIGMA
"""Up to which a view agrees in full where agreement is gradual; it is none at twice this."""
VISIBILITY = 3 * DEPTH_SIGMA
"""Between a point of the scene, which has little noise, and the map of a view that sees it."""

ADJACENT_PIXELS = 0.03
"""Between adjacent pixels: a wall at 80 degrees from its normal changes by less per pixel at 384 pixels across, one at
85 degrees by 0.02 at 512."""
WINDOW_PIXELS = 0.05
"""Between the middle of a window and pixels some steps away."""

SUBMODEL_AGREEMENT = 0.05
"""Between two submodels of one surface: sound overlaps have medians of 0.0003 to 0.046, broken ones of 0.15 to 0.76
(six real image sets)."""
