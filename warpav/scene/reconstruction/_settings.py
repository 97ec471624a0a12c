"""How captures become scenes: what is kept of the images, and how fine the meshes are."""

from __future__ import annotations

from dataclasses import dataclass, field

METHOD_PACKAGES = {"nksr": ("nksr", "torch")}
"""Packages that a surface method needs and that warpav does not bring along."""


@dataclass(frozen=True)
class CloudSettings:
    """What is kept of the images."""

    far_depth_m: float = 900.0  # depths from here on are sky [m] (thesis: near the upper limit of the depth images)
    radius_m: float = 40.0  # the environment beyond this distance from the ego frame's origin becomes a sphere [m]
    max_height_m: float = 10.0  # what is higher then is left out [m]
    # Points this far outside a 3D box still belong to the vehicle; as far inside, still to the environment, such as the
    # road below [m].
    box_margin_m: float = 0.02
    environment_grid_m: float = 0.08  # of the environment's points in a cell of this edge one is kept [m]


@dataclass(frozen=True)
class MeshSettings:
    """How a cloud becomes a mesh."""

    point_count: int  # points that are kept, by Poisson disks
    cell_m: float  # length of the cells in which the surface is found [m]
    reach_m: float  # surface farther than this from every point goes [m]
    triangle_count: int  # triangles that are kept, by quadric edge collapse
    piece_m2: float = 0.0  # loose pieces with less surface go [m2]: of thin things only blobs in the air would be left


@dataclass(frozen=True)
class ReconstructionSettings:
    """How a capture becomes a scene."""

    cloud: CloudSettings = field(default_factory=CloudSettings)  # what is kept of the images
    method: str = "poisson"  # surface method, a name of `SURFACE_METHODS`
    # For every vehicle; their points are not thinned.
    vehicle: MeshSettings = field(default_factory=lambda: MeshSettings(200_000, 0.03, 0.06, 4500))
    ego: MeshSettings = field(default_factory=lambda: MeshSettings(60_000, 0.03, 0.06, 5000))  # for the ego vehicle
    # For everything else within the radius.
    environment: MeshSettings = field(default_factory=lambda: MeshSettings(150_000, 0.25, 0.5, 36_000, 3.0))
    sphere_deg: float = 2.0  # size of the sphere's cells [deg]
    seed: int = 0  # of the Poisson disks
    thread_count: int = 2  # objects that are worked on at once
