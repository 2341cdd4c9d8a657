"""People as drawable parts of one frame, and the places that their shadows reach."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import box_corners
from cosfly.render.contract import LAYER_STEP, STANDING_LAYER, PosedPerson
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import CLOTH, PART, tags
from cosfly.render.person import figure_of

SHAPES = {"ball": meshes.SPHERE, "rounded": meshes.ROUNDED, "limb": meshes.LIMB, "disc": meshes.CYLINDER}
PERSON_RADIUS_M = 1.0  # radius of a sphere that holds a person

# A person casts the shadow of an upright capsule: lower and upper end of its axis from the hip, and its radius.
CAPSULE_M = np.array([-0.75, 0.72, 0.19])
PENUMBRA = 1.25  # a shadow ends this many radii from the axis
SKY_M = 0.6  # a person blocks light of the sky this far to each side
BELOW_M = 2.4  # a shadow ends this far below the hip
LONGEST_M = 60.0  # length of the longest shadow


class PersonParts(NamedTuple):
    """A person as k parts, relative to the origin."""

    records: np.ndarray  # (k,) PART
    mesh_numbers: np.ndarray  # (k,)


def person_parts(person: PosedPerson, instance_id: int, origin_m: np.ndarray) -> PersonParts:
    """Return the parts of a person's figure."""
    figure = figure_of(person)
    records = np.zeros(len(figure.shapes), PART)
    records["center"] = figure.centers_m - origin_m
    records["half"] = figure.half_m
    records["color"][:, :3] = figure.colors
    records["quaternion"] = Rotation.from_matrix(figure.turns).as_quat()
    records["tag"] = tags(KINDS["Pedestrians"], CLOTH, np.full(len(records), instance_id))
    records["bias"] = LAYER_STEP * STANDING_LAYER
    return PersonParts(records, np.array([SHAPES[shape] for shape in figure.shapes]))


def shadow_corners(hip: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Return points whose hull holds a person's shadow down to BELOW_M, and the sky light that it blocks, (16, 3).

    Args:
        hip: (3,) m.
        sun: (3,) unit vector towards the sun.
    """
    _, high_m, radius_m = CAPSULE_M
    top_m = high_m + PENUMBRA * radius_m
    half_m = np.array([SKY_M, SKY_M, (top_m + BELOW_M) / 2.0])
    body = box_corners(hip + np.array([0.0, 0.0, (top_m - BELOW_M) / 2.0]), half_m)
    length_m = min((top_m + BELOW_M) / max(float(sun[2]), 1e-3), LONGEST_M)
    return np.concatenate([body, body - length_m * sun])
