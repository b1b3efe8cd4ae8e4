"""MUSt3R in plain PyTorch: the network by itself.

    from smust3r_colmap.backbones import must3r

    network = must3r.load_checkpoint("MUSt3R_512.pth")
    images = [must3r.preprocess(photo, 512) for photo in photos]            # (H, W, 3) uint8 each
    tokens = must3r.encode(network, [image.pixels for image in images])
    memory = must3r.init_memory(network, tokens[:2]).memory                 # the first is the reference
    for token in tokens[2:]:
        memory = must3r.update_memory(network, memory, [token]).memory
    for raw in must3r.render(network, memory, tokens):
        maps = must3r.activate(raw)                                         # points and confidence per pixel
        focal_px = must3r.estimate_focal(maps.points_cam)
        world_from_cam = must3r.register_camera(maps.points_cam, maps.points_world, maps.confidence)

Inside, from the image to the pixel: ``preprocessing``, ``encoder`` (``blocks``, ``rope``), ``decoder`` with
``memory`` and ``head``, ``cameras``, ``full_image``. ``drivers`` runs the network over many
images, ``keyframes`` chooses which of them are remembered. ``checkpoint`` reads weights. ``backbone`` makes a
backbone of it all for the pipeline, with ``token_cache``, ``memory_plan``, ``precision`` and ``retrieval``.

Source: the network specification, by whose sections the modules are cut; the architecture is that of Cabon et al.,
"MUSt3R: Multi-view Network for Stereo 3D Reconstruction", CVPR 2025.
"""

from smust3r_colmap.backbones.must3r.cameras import estimate_focal, register_camera
from smust3r_colmap.backbones.must3r.checkpoint import load_checkpoint
from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.head import Pointmaps, activate
from smust3r_colmap.backbones.must3r.memory import Memory
from smust3r_colmap.backbones.must3r.network import (
    MemoryUpdate,
    Network,
    encode,
    init_memory,
    render,
    update_memory,
)
from smust3r_colmap.backbones.must3r.preprocessing import NetworkImage, preprocess

__all__ = [
    "EncodedImage",
    "Memory",
    "MemoryUpdate",
    "Network",
    "NetworkImage",
    "Pointmaps",
    "activate",
    "encode",
    "estimate_focal",
    "init_memory",
    "load_checkpoint",
    "preprocess",
    "register_camera",
    "render",
    "update_memory",
]
