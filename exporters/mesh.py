"""A mesh of a dense workspace, by Open3D, as PLY and as textured GLB.

``poisson`` fits one closed surface to the fused cloud and removes parts without points. It is smooth and closes holes
in well-covered places. ``tsdf`` averages the depth maps in a grid of voxels. It has only what was seen, with holes.

The PLY has a colour per vertex. The GLB has a real texture: every face takes its pixels from one undistorted image of
the workspace, the one that sees it largest, and the images that are used are laid side by side in one texture. Nothing
is blended, so exposure changes show as seams. The resolution is that of the workspace's images, which are as small as
the depth maps. Faces that no image sees well enough keep their vertex colours.

Open3D has a texture of its own (``compute_uvatlas``, then ``project_images_to_albedo``; both run on the CPU without a
screen). It was tried on a scene of known colours, six images of 165 x 121 pixels and 115,000 faces, and not taken:

- It needed 211 s (the atlas 140 s, the projection 71 s) and 1.4 GB, the texture here 2.5 s and 0.4 GB. Meshes of real
  scenes have ten times as many faces.
- At the middle of a face its colour was off by 2.3 grey levels in the median and 4.9 at the 90th percentile, here by
  0.7 and 1.3: it resamples and blends what is copied here.
- It asks for a manifold mesh, and does not tell which faces no image sees.

Open3D is imported here only, and in a child process: a machine without its system libraries loses the mesh and nothing
else.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pycolmap
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from smust3r_colmap.errors import InputError, MissingDependencyError, ReconstructionError, advice_for
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray, UInt8Array
from smust3r_colmap.geometry.camera import pixel_centres
from smust3r_colmap.geometry.depth_noise import VISIBILITY
from smust3r_colmap.storage.atomic_write import write_atomically

MIN_POINTS = 100
"""Fewer points of the cloud make no surface worth a file."""
BULK_PERCENTILES = (1.0, 99.0)
BULK_MARGIN_PER_EXTENT = 0.5
"""Points beyond the percentiles by more than this part of the extent are left out: both methods divide the whole
extent, so one stray point far away would cost all resolution."""
CELL_PER_SPACING = 2.0
"""Edge of the smallest octree cell over the usual distance of neighbouring points."""
OCTREE_DEPTHS = (6, 10)
"""Least and most; each step takes about four times the memory and time, 10 needs some GB."""
MAX_COARSER_LEVELS = 1.5
"""Octree levels below the median density from which on a vertex is cut away. On real clouds that leaves one vertex in
a thousand farther than eight point spacings from any point, three levels leave fifteen."""
VOXEL_PER_PIXEL = 1.5
"""Edge of a voxel over the width of a pixel at the median depth."""
MAX_GRID_VOXELS = 1024
"""Voxels along the longest side of the bulk at most."""
BLOCK_VOXELS, FIRST_BLOCKS = 8, 10_000
"""Voxels per side of the blocks in which space near surfaces is kept, and blocks to start with (100 MB); it grows."""
MIN_MAPS = 2
"""Depth maps that must cover a voxel."""
MIN_COMPONENT_SHARE = 1e-3
"""Connected components with fewer faces than this share of all are removed."""

MAX_TEXTURE_PX = 8192
"""Side of the texture; the largest that graphics hardware has in common."""
MAX_TEXTURE_VIEWS = 100
MIN_NEW_FACES_SHARE = 2e-3
"""Images are added to the texture while they show at least this part of the faces for the first time."""
MAX_FACES_TO_CHOOSE_BY = 50_000
"""Faces, evenly drawn, by which the images are chosen; all images times all faces would not fit in memory."""
MIN_VIEW_COSINE = 0.15
"""Cosine between a face's normal and the direction to the camera; flatter views smear."""
BETTER_VIEW_RATIO = 1.5
"""How many times more pixels a face must have in another image to be taken from that: fewer, larger patches."""
_UNSEEN = -1
_JPEG_QUALITY = 92

MeshMethod = Literal["poisson", "tsdf"]


@dataclass(frozen=True, kw_only=True)
class MeshReport:
    """What was written.

    Args:
        ply, glb: the files.
        num_vertices, num_faces: of the PLY.
        num_views: images in the texture.
        textured: part of the faces that have pixels of an image.
    """

    ply: Path
    glb: Path
    num_vertices: int
    num_faces: int
    num_views: int
    textured: float


@dataclass(frozen=True, kw_only=True)
class _MeshTask:
    workspace: Path
    method: MeshMethod


@dataclass(frozen=True, kw_only=True)
class _NoOpen3D:
    advice: str


@dataclass(frozen=True, kw_only=True, eq=False)
class _Mesh:
    """Vertices (V, 3) with colours (V, 3), and faces (F, 3)."""

    vertices: FloatArray
    rgb: UInt8Array
    faces: IntArray


def write_mesh(workspace: Path, method: MeshMethod, *, log_file: Path | None = None) -> MeshReport:
    """Write ``mesh_<method>.ply`` and ``mesh_<method>.glb`` into a workspace.

    Args:
        workspace: as ``write_dense_workspace`` makes it.
        method: see the module.
        log_file: for the messages of native code.

    Raises:
        MissingDependencyError: Open3D cannot be imported; the message says what to install.
        InputError: the workspace is not whole, or its cloud has fewer than ``MIN_POINTS`` points.
        ReconstructionError: no surface came out.
        StorageError: the disk refused.
    """
    needed = ("sparse/images.bin", "stereo/fusion.cfg", "fused.ply")
    missing = [name for name in needed if not (workspace / name).is_file()]
    if missing:
        raise InputError(f"{workspace}: there is no {missing[0]}; give a dense workspace, with --dense")
    num_points = len(_read_cloud(workspace)[0])
    if num_points < MIN_POINTS:
        raise InputError(f"{workspace / 'fused.ply'}: {num_points} points, a mesh needs at least {MIN_POINTS}")
    report = in_child(_make_mesh, _MeshTask(workspace=workspace, method=method), log_file=log_file)
    if isinstance(report, TaskFailure):
        raise ReconstructionError(f"the {method} mesh failed: {report.reason}")
    if isinstance(report, _NoOpen3D):
        raise MissingDependencyError(f"a mesh needs open3d: {report.advice}")
    return report


def _make_mesh(task: _MeshTask) -> MeshReport | _NoOpen3D:
    """In the child process."""
    try:
        import open3d  # noqa: PLC0415  (heavy, optional, and it may crash the process)
    except ImportError as error:
        return _NoOpen3D(advice=advice_for(str(error)))
    views = list(_views(task.workspace))
    mesh = _poisson(open3d, task.workspace) if task.method == "poisson" else _tsdf(open3d, task.workspace, views)
    if not len(mesh.faces):
        raise ReconstructionError("no face is left; the points are too few or too scattered")
    ply, glb = (task.workspace / f"mesh_{task.method}.{suffix}" for suffix in ("ply", "glb"))
    write_atomically(ply, _as_trimesh(mesh).export(file_type="ply"))
    chosen = _chosen_views(mesh, views)
    view_of_face = _best_views(mesh, chosen)
    write_atomically(glb, _as_glb(mesh, chosen, view_of_face))
    return MeshReport(
        ply=ply,
        glb=glb,
        num_vertices=len(mesh.vertices),
        num_faces=len(mesh.faces),
        num_views=len(np.unique(view_of_face[view_of_face != _UNSEEN])),
        textured=float(np.mean(view_of_face != _UNSEEN)),
    )


def _as_trimesh(mesh: _Mesh) -> Any:
    return trimesh.Trimesh(vertices=mesh.vertices, faces=mesh.faces, vertex_colors=mesh.rgb, process=False)


# --------------------------------------------------------------------------- workspace
@dataclass(frozen=True, kw_only=True)
class _View:
    """An image of the workspace with its camera; pixels are read when asked for.

    Args:
        img_from_cam: (3, 3). cam_from_world: (3, 4).
    """

    workspace: Path
    name: str
    width: int
    height: int
    img_from_cam: FloatArray
    cam_from_world: FloatArray

    def depth(self) -> npt.NDArray[np.float32]:
        """(H, W), 0 where there is none."""
        depth_map = pycolmap.DepthMap()
        depth_map.read(self.workspace / f"stereo/depth_maps/{self.name}.geometric.bin")
        return np.ascontiguousarray(depth_map.to_array(), dtype=np.float32)

    def rgb(self) -> UInt8Array:
        """(H, W, 3)."""
        with Image.open(self.workspace / "images" / self.name) as image:
            return np.asarray(image.convert("RGB"))

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N, 2) places in the image, NaN behind the camera, and (N,) depths of points (N, 3) in the world."""
        points_img = (points @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3]) @ self.img_from_cam.T
        z = points_img[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(z[:, None] > 0, points_img[:, :2] / z[:, None], np.nan)
        return xy, z

    def points_world(self, depth: npt.NDArray[np.float32]) -> FloatArray:
        """(H, W, 3) points of a depth map (H, W)."""
        pixels = np.column_stack([pixel_centres(self.width, self.height), np.ones(depth.size)])
        points_cam = pixels @ np.linalg.inv(self.img_from_cam).T * depth.reshape(-1, 1)
        points: FloatArray = (points_cam - self.cam_from_world[:, 3]) @ self.cam_from_world[:, :3]
        return points.reshape(*depth.shape, 3)

    def centre(self) -> FloatArray:
        """(3,) in the world."""
        centre: FloatArray = -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]
        return centre


def _views(workspace: Path) -> Iterator[_View]:
    """The images with a depth map, in the order of ``fusion.cfg``."""
    model = pycolmap.Reconstruction(workspace / "sparse")
    for name in (workspace / "stereo/fusion.cfg").read_text(encoding="utf-8").splitlines():
        image = model.find_image_with_name(name)
        if image is None:
            raise InputError(f"{workspace / 'stereo/fusion.cfg'}: names {name}, which the model does not hold")
        camera = model.camera(image.camera_id)
        yield _View(
            workspace=workspace,
            name=name,
            width=camera.width,
            height=camera.height,
            img_from_cam=np.asarray(camera.calibration_matrix()),
            cam_from_world=np.asarray(image.cam_from_world().matrix()),
        )


def _read_cloud(workspace: Path) -> tuple[FloatArray, FloatArray, UInt8Array]:
    """Points, normals and colours (P, 3) of ``fused.ply``."""
    with (workspace / "fused.ply").open("rb") as file:
        header = file.read(4096)
    end = header.index(b"end_header\n") + len(b"end_header\n")
    count = next(int(line.split()[2]) for line in header[:end].split(b"\n") if line.startswith(b"element vertex"))
    # As COLMAP writes it: place and normal in single precision, then the colour.
    layout = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    rows = np.fromfile(workspace / "fused.ply", dtype=layout, count=count, offset=end)
    return rows["xyz"].astype(np.float64), rows["normal"].astype(np.float64), rows["rgb"]


def _bulk_box(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner (3,) of the box round most of the points (P, 3)."""
    low, high = np.percentile(points, BULK_PERCENTILES, axis=0)
    margin = BULK_MARGIN_PER_EXTENT * (high - low)
    return low - margin, high + margin


def _inside(points: FloatArray, box: tuple[FloatArray, FloatArray]) -> BoolArray:
    """(...) which of the points (..., 3) lie in the box."""
    return np.asarray(((points >= box[0]) & (points <= box[1])).all(axis=-1))


# ---------------------------------------------------------------------------- surfaces
def _poisson(open3d: Any, workspace: Path) -> _Mesh:
    """Source: Kazhdan and Hoppe, Screened Poisson Surface Reconstruction, 2013; as Open3D has it."""
    points, normals, rgb = _read_cloud(workspace)
    bulk = _inside(points, _bulk_box(points))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[bulk]))
    cloud.normals = open3d.utility.Vector3dVector(normals[bulk])
    cloud.colors = open3d.utility.Vector3dVector(rgb[bulk] / 255.0)
    # One thread, because the order of its sums would change the mesh from run to run.
    mesh, densities = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=_octree_depth(points[bulk]), n_threads=1
    )
    # A density is the depth of the octree at which the samples lie: one less is twice as coarse.
    depths = np.asarray(densities)
    mesh.remove_vertices_by_mask(depths < np.median(depths) - MAX_COARSER_LEVELS)
    return _cleaned(open3d, mesh)


def _octree_depth(points: FloatArray) -> int:
    """The depth whose cells are ``CELL_PER_SPACING`` times the distance of neighbouring points."""
    spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    cells = np.ptp(points, axis=0).max() / max(CELL_PER_SPACING * spacing, np.finfo(np.float64).tiny)
    return int(np.clip(math.ceil(math.log2(max(cells, 1.0))), *OCTREE_DEPTHS))


def _tsdf(open3d: Any, workspace: Path, views: Sequence[_View]) -> _Mesh:
    """Source: Curless and Levoy, A Volumetric Method for Building Complex Models from Range Images, 1996."""
    box = _bulk_box(_read_cloud(workspace)[0])
    voxel, truncation = _voxel_size(views, box)
    tensor, number = open3d.core.Tensor, open3d.core.float32
    volume = open3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(number, number, number),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel,
        block_resolution=BLOCK_VOXELS,
        block_count=FIRST_BLOCKS,
    )
    for view in views:
        depth = view.depth()
        depth[~_inside(view.points_world(depth), box)] = 0
        if not depth.any():
            continue
        # This volume takes the pixel that a place falls into, which are the model's own coordinates.
        camera = tensor(view.img_from_cam)
        pose = tensor(np.vstack([view.cam_from_world, [0, 0, 0, 1]]))
        depth_image = open3d.t.geometry.Image(tensor(depth))
        colours = open3d.t.geometry.Image(tensor(view.rgb().astype(np.float32) / 255))
        reach = {
            "depth_scale": 1.0,
            "depth_max": 1.01 * float(depth.max()),
            "trunc_voxel_multiplier": truncation / voxel,
        }
        blocks = volume.compute_unique_block_coordinates(depth_image, camera, pose, **reach)
        volume.integrate(blocks, depth_image, colours, camera, pose, **reach)
    if not volume.hashmap().size():
        raise ReconstructionError("no depth lies near the fused cloud")
    return _cleaned(open3d, volume.extract_triangle_mesh(weight_threshold=MIN_MAPS - 0.5).to_legacy())


def _voxel_size(views: Sequence[_View], box: tuple[FloatArray, FloatArray]) -> tuple[float, float]:
    """Edge of a voxel and the distance from the surface up to which a map counts, in the unit of the model."""
    depths, pixels = [], []
    for view in views:
        depth = view.depth()
        if depth.any():
            depths.append(float(np.median(depth[depth > 0])))
            pixels.append(depths[-1] / view.img_from_cam[0, 0])
    if not depths:
        raise ReconstructionError("no depth map has a pixel")
    finest = float((box[1] - box[0]).max()) / MAX_GRID_VOXELS
    voxel = max(VOXEL_PER_PIXEL * float(np.median(pixels)), finest)
    return voxel, max(VISIBILITY * float(np.median(depths)), 3 * voxel)


def _cleaned(open3d: Any, mesh: Any) -> _Mesh:
    """Without small components and unused vertices."""
    mesh.remove_degenerate_triangles()
    part_of_face, faces_of_part, _ = mesh.cluster_connected_triangles()
    faces_of_part = np.asarray(faces_of_part)
    if len(faces_of_part):
        specks = faces_of_part < MIN_COMPONENT_SHARE * faces_of_part.sum()
        mesh.remove_triangles_by_mask(specks[np.asarray(part_of_face)])
        mesh.remove_unreferenced_vertices()
    return _Mesh(
        vertices=np.asarray(mesh.vertices, dtype=np.float64),
        rgb=np.rint(255 * np.clip(np.asarray(mesh.vertex_colors), 0, 1)).astype(np.uint8),
        faces=np.asarray(mesh.triangles, dtype=np.int64),
    )


# ----------------------------------------------------------------------------- texture
def _chosen_views(mesh: _Mesh, views: Sequence[_View]) -> list[_View]:
    """Images that together show most of the mesh, the one with most faces first; greedy set cover."""
    faces = mesh.faces[:: max(1, len(mesh.faces) // MAX_FACES_TO_CHOOSE_BY)]
    sees = np.array([_pixels_per_face(mesh, faces, view) > 0 for view in views])
    chosen: list[_View] = []
    while len(chosen) < MAX_TEXTURE_VIEWS:
        gains = sees.sum(axis=1)
        best = int(np.argmax(gains))
        if gains[best] < max(MIN_NEW_FACES_SHARE * len(faces), 1):
            break
        chosen.append(views[best])
        sees &= ~sees[best]
    return chosen


def _best_views(mesh: _Mesh, views: Sequence[_View]) -> IntArray:
    """(F,) position of the image that each face takes its pixels from, ``_UNSEEN`` where there is none."""
    view_of_face = np.full(len(mesh.faces), _UNSEEN)
    pixels = np.zeros(len(mesh.faces))
    for position, view in enumerate(views):
        here = _pixels_per_face(mesh, mesh.faces, view)
        better = here > BETTER_VIEW_RATIO * pixels
        view_of_face[better] = position
        pixels[better] = here[better]
    return view_of_face


def _pixels_per_face(mesh: _Mesh, faces: IntArray, view: _View) -> FloatArray:
    """(F,) area in pixels of the faces in an image; 0 where it does not see them, or too flat.

    A face is seen when its corners lie in the image, it faces the camera, and the depth map has its centre there.
    """
    corners_xy, _ = view.project(mesh.vertices)
    a, b, c = (corners_xy[faces[:, k]] for k in range(3))
    with np.errstate(invalid="ignore"):
        within = [((xy > 0) & (xy < (view.width, view.height))).all(axis=1) for xy in (a, b, c)]
    in_image = np.logical_and.reduce(within)
    pixels = np.zeros(len(faces))
    rows = np.flatnonzero(in_image)
    a, b, c, seen = a[rows], b[rows], c[rows], faces[rows]
    first, second, third = (mesh.vertices[seen[:, k]] for k in range(3))
    centres = (first + second + third) / 3
    normals = np.cross(second - first, third - first)
    to_camera = view.centre() - centres
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(to_camera, axis=1)
    facing = np.einsum("fi,fi->f", normals, to_camera) > MIN_VIEW_COSINE * lengths
    xy, z = view.project(centres)
    column, row = np.clip(xy.astype(np.intp), 0, (view.width - 1, view.height - 1)).T
    visible = np.abs(view.depth()[row, column] - z) <= VISIBILITY * z
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    pixels[rows] = np.where(facing & visible, np.abs(ux * vy - uy * vx) / 2, 0)
    return pixels


def _as_glb(mesh: _Mesh, views: Sequence[_View], view_of_face: IntArray) -> bytes:
    """A binary glTF with a textured mesh and, where some faces are unseen, one with vertex colours."""
    # glTF is y up and in single precision: turned, and written about a point in its middle.
    origin = np.median(mesh.vertices, axis=0)
    about_origin = _Mesh(vertices=mesh.vertices - origin, rgb=mesh.rgb, faces=mesh.faces)
    gltf_from_mesh = np.diag([1.0, -1.0, -1.0, 1.0])
    gltf_from_mesh[:3, 3] = gltf_from_mesh[:3, :3] @ origin
    document = trimesh.Scene()
    seen = view_of_face != _UNSEEN
    if seen.any():
        textured = _textured(about_origin, mesh.faces[seen], views, view_of_face[seen], origin)
        document.add_geometry(textured, geom_name="textured", transform=gltf_from_mesh)
    if not seen.all():
        rest = _as_trimesh(_Mesh(vertices=about_origin.vertices, rgb=mesh.rgb, faces=mesh.faces[~seen]))
        rest.remove_unreferenced_vertices()
        document.add_geometry(rest, geom_name="coloured", transform=gltf_from_mesh)
    content: bytes = document.export(file_type="glb")  # type: ignore[no-untyped-call]
    return content


def _textured(mesh: _Mesh, faces: IntArray, views: Sequence[_View], view_of_face: IntArray, origin: FloatArray) -> Any:
    """The faces with the texture of all images; a vertex is repeated for every image that its faces use."""
    tiles = _Tiles.of(views)
    corners, corner_of = np.unique(faces * len(views) + view_of_face[:, None], return_inverse=True)
    vertex, position = corners // len(views), corners % len(views)
    uv = np.empty((len(corners), 2))
    for k, view in enumerate(views):
        here = position == k
        xy, _ = view.project(mesh.vertices[vertex[here]] + origin)
        uv[here] = tiles.uv(k, xy)
    material = trimesh.visual.material.PBRMaterial(  # type: ignore[no-untyped-call]
        baseColorTexture=tiles.picture(views), metallicFactor=0.0, roughnessFactor=1.0
    )
    return trimesh.Trimesh(
        vertices=mesh.vertices[vertex],
        faces=corner_of.reshape(-1, 3),
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),  # type: ignore[no-untyped-call]
        process=False,
    )


@dataclass(frozen=True, kw_only=True)
class _Tiles:
    """Where the images lie in the texture: row by row in cells of one size, all shrunk alike if they must be."""

    columns: int
    rows: int
    cell_width: int
    cell_height: int
    shrink: float

    @classmethod
    def of(cls, views: Sequence[_View]) -> _Tiles:
        width, height = max(view.width for view in views), max(view.height for view in views)
        columns = max(1, min(len(views), round(math.sqrt(len(views) * height / width))))
        rows = math.ceil(len(views) / columns)
        shrink = min(1.0, MAX_TEXTURE_PX / (columns * width), MAX_TEXTURE_PX / (rows * height))
        return cls(
            columns=columns,
            rows=rows,
            cell_width=max(1, int(width * shrink)),
            cell_height=max(1, int(height * shrink)),
            shrink=shrink,
        )

    def corner(self, k: int) -> tuple[int, int]:
        """Column and row of the first pixel of image k."""
        return k % self.columns * self.cell_width, k // self.columns * self.cell_height

    def uv(self, k: int, xy: FloatArray) -> FloatArray:
        """(N, 2) texture coordinates, from 0 to 1 and v upward, of places (N, 2) in image k."""
        place = np.array(self.corner(k)) + xy * self.shrink
        u, v = (place / (self.columns * self.cell_width, self.rows * self.cell_height)).T
        return np.column_stack([u, 1 - v])

    def picture(self, views: Sequence[_View]) -> Image.Image:
        """All images side by side, to be stored as JPEG."""
        picture = Image.new("RGB", (self.columns * self.cell_width, self.rows * self.cell_height))
        for k, view in enumerate(views):
            size = (max(1, int(view.width * self.shrink)), max(1, int(view.height * self.shrink)))
            picture.paste(Image.fromarray(view.rgb()).resize(size, Image.Resampling.BOX), self.corner(k))
        encoded = io.BytesIO()
        picture.save(encoded, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
        return Image.open(encoded)  # trimesh keeps the format that a picture came in
