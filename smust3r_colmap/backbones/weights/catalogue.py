"""The official files of MUSt3R, and what their licence says.

None of them comes with this package. The next module is ``cache``.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from smust3r_colmap.errors import ConfigError

Kind = Literal["network", "retrieval head", "codebook"]

BASE_ADDRESS = "https://download.europe.naverlabs.com/ComputerVision/MUSt3R"
"""Where the publisher keeps them (network specification, section 2)."""

NETWORK_TENSOR_BYTES = 1_693_720_576
"""Of the tensors of a network, the same for all three; the publisher gives no file sizes."""


@dataclass(frozen=True, kw_only=True)
class OfficialFile:
    """One published file.

    Args:
        name: of the file, also in the cache.
        md5: published sum, 32 hexadecimal digits.
        kind: what it holds.
        image_size: longer side in pixels of the images that it was trained with.
    """

    name: str
    md5: str
    kind: Kind
    image_size: int


# Of equal kind and size, the better one first: it was trained longer and with more views.
CATALOGUE: Sequence[OfficialFile] = (
    OfficialFile(name="MUSt3R_512.pth", md5="8854f948a8674fb1740258c1872f80dc", kind="network", image_size=512),
    OfficialFile(name="MUSt3R_512_cvpr.pth", md5="43808705f381a8724aafcd27c88ece35", kind="network", image_size=512),
    OfficialFile(name="MUSt3R_224_cvpr.pth", md5="ac176abd2b2c3bc5f2aea664d82e9ffa", kind="network", image_size=224),
    OfficialFile(
        name="MUSt3R_512_retrieval_trainingfree.pth",
        md5="f7c133906bcfd4fe6ee157a9ffa85a23",
        kind="retrieval head",
        image_size=512,
    ),
    OfficialFile(
        name="MUSt3R_512_retrieval_codebook.pkl",
        md5="1125d80b9de940de2655d19b3ff78bb5",
        kind="codebook",
        image_size=512,
    ),
    OfficialFile(
        name="MUSt3R_224_retrieval_trainingfree.pth",
        md5="2a82597c3317efac40657d4f881c71f0",
        kind="retrieval head",
        image_size=224,
    ),
    OfficialFile(
        name="MUSt3R_224_retrieval_codebook.pkl",
        md5="e675ec36c7c40d512ef321fdd289bdbe",
        kind="codebook",
        image_size=224,
    ),
)

RECOMMENDED = CATALOGUE[0].name

# Facts from the network specification, section 1. Our summary; the publisher's text alone counts.
LICENCE_SUMMARY = """\
The weights of MUSt3R are no part of smust3r-colmap and not under its licence. NAVER Corporation
publishes them under its own "MUSt3R Non-Commercial License" (2025). In plain words, which do not
replace that text:

- They may be used for non-commercial purposes only. This binds whoever uses the files, a person or
  an organisation, and covers the source, the models, the checkpoints and the data together; a file
  that `weights convert` makes of them is under the same terms.
- The right may not be passed on or sublicensed. What is derived from them may not be distributed
  under other terms, and notices have to stay. Whoever breaks the terms loses the right.
- They were trained on data with terms of its own: CO3Dv2 (CC BY-NC 4.0), ScanNet++ (own terms),
  BlendedMVS (CC BY 4.0), StaticThings3D (research only), WildRGB-D (MIT), TartanAir (CC BY 4.0),
  UnrealStereo4K (MIT), Virtual KITTI 2 (CC BY-NC-SA 3.0), DL3DV (CC BY-NC 4.0), Niantic Map-free
  (non-commercial, very restrictive); in MUSt3R_512.pth also Infinigen (BSD-3) and Hypersim
  (CC BY-SA 3.0). They derive from the CroCo v2 model.

The texts are LICENSE and NOTICE in https://github.com/naver/must3r; read them before you accept."""


def official(name: str) -> OfficialFile:
    """The file of this name.

    Raises:
        ConfigError: there is none; the message lists those that there are.
    """
    found = find_official(name)
    if found is not None:
        return found
    names = [file.name for file in CATALOGUE]
    close = difflib.get_close_matches(name, names, n=1)
    guess = f"did you mean {close[0]}? " if close else ""
    raise ConfigError(f"{name}: no official file of MUSt3R; {guess}there are {', '.join(names)}")


def find_official(name: str) -> OfficialFile | None:
    """The file of this name, if there is one."""
    return next((file for file in CATALOGUE if file.name == name), None)


def official_with_sum(md5: str) -> OfficialFile | None:
    """The file with this sum, if there is one."""
    return next((file for file in CATALOGUE if file.md5 == md5), None)
