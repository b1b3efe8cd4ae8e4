"""Settings of ``reconstruct`` that go together, and what they were measured to do.

With ``--workers 1 --no-trainer --no-dense``; position error in percent of the extent of the path, then seconds of
processor time. All images are registered in one model. The same stage of the same run differs by up to 9 % in time.

    data set        default          fast
    fountain_p11    0.017 %,  56 s   0.019 %,  56 s
    castle_p30      0.049 %, 164 s   0.051 %, 140 s
    lund_street     0.082 %, 148 s   0.072 %, 122 s

Tried and left out: ``max_features`` 2048 with ``max_image_size`` 1200 breaks lund_street into two models, the larger of
16 of 29 images; ``max_features`` 8192 takes 68 s on fountain_p11 and is no more accurate (0.019 %).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from smust3r_colmap.storage.config_file import Setting

Preset = Literal["fast", "default", "thorough"]

PRESETS: Mapping[str, Mapping[str, Setting]] = {
    "fast": {
        "max_features": 3072,  # matching costs the square of it
        "match_neighbours": 5,  # fewer pairs to match; with 3072 features matching takes 35 to 50 % less
        "dense": False,  # the workspace is 6.5 of 66 s of fountain_p11 with all outputs
    },
    "default": {},
    "thorough": {
        "register_missing": True,  # costs nothing where every image has a pose, as in the sets above
    },
}
