"""Settings of ``reconstruct`` that go together.

Measured with one worker, without ``trainer/`` and ``dense/``: processor time, and position error (rms) against ground
truth or, for lund_street, against COLMAP's global model. All images were registered.

    ============  ================  =================  ==================
    preset        fountain_p11      castle_p30         lund_street
    ============  ================  =================  ==================
    default       52 s, 0.0027 m    160 s, 0.0270 m    143 s, 0.08 %
    fast          56 s, 0.0029 m    140 s, 0.0281 m    122 s, 0.07 %
    thorough      68 s, 0.0030 m    not measured       not measured
    ============  ================  =================  ==================

So ``fast`` saves little where features take most of the time; its larger saving is ``dense/``, which it leaves out.
With 2,048 features lund_street fell into two models.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from smust3r_colmap.storage.config_file import Setting

Preset = Literal["fast", "default", "thorough"]

PRESETS: Mapping[str, Mapping[str, Setting]] = {
    "fast": {"max_features": 3072, "match_neighbours": 5, "dense": False},
    "default": {},
    "thorough": {"max_features": 8192, "register_missing": True},
}
