"""What moves, as drawable parts of one frame: the figures of people, cars, and the capsules that cast the shadows of
others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import rotation_matrix
from cosfly.render.contract import LAYER_STEP, PERSON_ID, STANDING_LAYER, PosedBystander, PosedCar, PosedPerson
from cosfly.render.figure import figure_of
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import CLOTH, PART, Boxes, PartBuilder, tags
from cosfly.render.gl.shapes import BUILDERS
from cosfly.render.gl.view import CameraView

SHAPES = {"ball": meshes.SPHERE, "rounded": meshes.ROUNDED, "limb": meshes.LIMB, "disc": meshes.CYLINDER}


@dataclass(frozen=True)
class Body:
    """A posed figure as drawable parts, k of them and b bones.

    records: (k,) parts.PART without centers; mesh: (k,); centers_m: (k, 3) world; bones_m: (b, 2, 3) world, the ends of
    the capsules that cast the shadow; bone_radii_m: (b,); center_m: (3,) the hip point.
    """

    records: np.ndarray
    mesh: np.ndarray
    centers_m: np.ndarray
    bones_m: np.ndarray
    bone_radii_m: np.ndarray
    center_m: np.ndarray


def make_body(person: PosedPerson, instance_id: int = PERSON_ID) -> Body:
    """Make the figure of a posed person, the target or another."""
    figure = figure_of(person)
    records = np.zeros(len(figure.shapes), PART)
    records["half"], records["color"][:, :3] = figure.half_m, figure.colors
    records["quaternion"] = Rotation.from_matrix(figure.turns).as_quat()
    records["tag"] = tags(KINDS["Pedestrians"], CLOTH, np.full(len(records), instance_id))
    records["bias"] = LAYER_STEP * STANDING_LAYER
    mesh = np.array([SHAPES[shape] for shape in figure.shapes])
    hip_m = np.asarray(person.hip_m, dtype=np.float64)
    return Body(records, mesh, figure.centers_m, figure.bones_m, figure.bone_radii_m, hip_m)


MOST_CAPSULES = 32  # as many as the shader has room for: the nearest to the camera
SHADOW_M = 5.0  # of a sphere that holds a shadow too, under a sun that stands as usual
PERSON_RADIUS_M = 1.0  # of a sphere round a person
PERSON_CAPSULE_M = (0.15, 1.62, 0.19)  # low and high end over the feet, radius


def placed(body: Body, origin_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the records of a figure with their places, and their meshes."""
    records = body.records.copy()
    records["center"] = body.centers_m - origin_m
    return records, body.mesh


def draw_bystanders(
    others: Sequence[PosedBystander], origin_m: np.ndarray, view: CameraView
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return records and meshes of the others whom the camera may see."""
    found = []
    for other in others:
        center = other.center_m - origin_m
        if isinstance(other.body, PosedPerson):
            if view.can_show(center, PERSON_RADIUS_M):
                found.append(placed(make_body(other.body, other.instance_id), origin_m))
        elif view.can_show(center, float(np.linalg.norm(other.body.half_extents_m))):
            found.append(_car(other.body, other.instance_id, center, view))
    return found


def _car(car: PosedCar, instance_id: int, center: np.ndarray, view: CameraView) -> tuple[np.ndarray, np.ndarray]:
    """Return a car of the same shape as those that a map has parked."""
    builder, turn = PartBuilder(), rotation_matrix(0.0, car.heading_rad, 0.0)
    half, ids = np.array(car.half_extents_m), np.array([instance_id], np.uint16)
    BUILDERS[KINDS["Car"]](
        builder, Boxes(center[None], half[None], turn[None], ids, np.array([car.seed]), KINDS["Car"], np.zeros(1))
    )
    parts = builder.finish()
    rows = view.rows(parts)
    return parts.records[rows], parts.mesh[rows]


def capsules_of(others: Sequence[PosedBystander], origin_m: np.ndarray, view: CameraView) -> np.ndarray:
    """Capsules of the others whose shadows the camera may see, relative to the origin, (k, 2, 4): from and radius, to
    and instance id.

    Every pixel asks every capsule, which costs more than all else that is drawn of others.
    """
    seen = (other for other in others if view.can_show(other.center_m - origin_m, SHADOW_M))
    nearest = sorted(seen, key=lambda other: float(np.linalg.norm(other.center_m - origin_m - view.eye)))[
        :MOST_CAPSULES
    ]
    capsules = np.zeros((len(nearest), 2, 4), np.float32)
    for capsule, other in zip(capsules, nearest, strict=True):
        center = other.center_m - origin_m
        if isinstance(other.body, PosedPerson):
            low, high, radius = PERSON_CAPSULE_M
            ends = center + np.array([[0.0, 0.0, low], [0.0, 0.0, high]]) - [0.0, 0.0, TARGET_HEIGHT_M]
        else:
            length, width, height = other.body.half_extents_m
            ahead = (length - width) * np.array([np.cos(other.body.heading_rad), np.sin(other.body.heading_rad), 0.0])
            radius = max(width, height)
            ends = center + np.array([-ahead, ahead])
        capsule[:, :3], capsule[0, 3], capsule[1, 3] = ends, radius, other.instance_id
    return capsules
