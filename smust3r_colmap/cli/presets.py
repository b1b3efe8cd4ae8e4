"""Settings of ``reconstruct`` that go together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from smust3r_colmap.storage.config_file import Setting

Preset = Literal["fast", "default", "thorough"]

PRESETS: Mapping[str, Mapping[str, Setting]] = {
    "fast": {"max_image_size": 1200, "max_features": 2048, "dense": False},
    "default": {},
    "thorough": {"max_features": 8192, "register_missing": True},
}
