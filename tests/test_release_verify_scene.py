"""What neighbouring pictures of a flight say of each other, and what the ground beside the feet says of a depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosfly.products.kinds import KINDS
from cosfly.space.reprojection import Agreement
from release.columns import POSE
from release.flight_rows import FlightRows
from release.verify import scene
from release.verify.findings import Findings
from release.verify.pictures import ground_beside

WHOLE = Agreement(
    seen=2000, agree=2000, hidden=0, through=0, same=2000, planes=1700, shifted=0, renamed=0, error=0.0,
    error_flat=0.0, error_standing=0.0
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({}, None), ({"renamed": 34}, "scene_instance"), ({"same": 1800}, "scene_instance"),
        ({"shifted": 20}, "scene_depth"),
        ({"agree": 900, "same": 900}, "scene_depth"), ({"through": 60}, "scene_depth"),
        ({"error": 0.001}, "scene_depth"),
        ({"error_flat": 0.0001, "error_standing": 0.001}, None),
    ],
)  # fmt: skip
def test_neighbouring_frames_show_one_world(change, code):
    found = [WHOLE] * 20
    found[12] = replace(WHOLE, **change)
    rows = [
        {"frame_index": k, "target_mask_bbox": dict.fromkeys(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), 9.0)}
        for k in range(21)
    ]
    findings = Findings()
    pairs = [(k, 1, pair) for k, pair in enumerate(found, 1)]
    scene._judge_pairs(
        FlightRows("run/Town/trajectory/ORI", rows, given_id="trajectory_ORI"), pairs, "float32", findings
    )
    assert [kind.code for kind in findings.kinds.values()] == [code] * (code is not None)


@pytest.mark.parametrize(
    ("name", "error", "is_found"),
    [("error_flat", 1e-6, False), ("error_flat", 8e-5, True), ("error_standing", 3e-5, False),
     ("error_standing", 1.8e-4, True)],
)  # fmt: skip
def test_planes_keep_their_place_through_a_flight(name, error, is_found):
    """8e-5 is of depth set off by 0.3 m, 1.8e-4 of depth scaled by 2 %."""
    findings = Findings()
    flight = FlightRows("run/Town/trajectory/ORI", [{"frame_index": 0}])
    scene._judge_scale(flight, [(0, 1, replace(WHOLE, **{name: error}))] * 9, findings)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_depth"] * is_found


@pytest.mark.parametrize(("scale", "id_of_ground", "expected_m"), [(1.0, 1, 0.0), (1.02, 1, -0.4), (1.0, 0, np.nan)])
def test_ground_beside_the_feet(scale, id_of_ground, expected_m):
    """A camera 20 m above a road that looks down 45 degrees, at somebody 20 m ahead. The plane below everything, of no
    id, says nothing."""
    row = {
        "frame_index": 0, "pose": dict.fromkeys(POSE, 0.0) | {"z_m": 20.0, "pitch_deg": -45.0}, "width_px": 160,
        "height_px": 120,
        "intrinsics": {"fx": 140.0, "fy": 140.0, "cx": 80.0, "cy": 60.0},
        "target": {"x_m": 20.0, "y_m": 0.0, "z_m": 0.9},
    }  # fmt: skip
    v = (np.mgrid[:120, :160][0] + 0.5 - 60.0) / 140.0
    depth = (20.0 / (np.sin(np.pi / 4) + v * np.cos(np.pi / 4)) * scale).astype(np.float32)
    instance = np.zeros((120, 160, 3), np.uint8)
    instance[:] = (KINDS["Roads"], id_of_ground, 0)
    found = ground_beside(FlightRows("run/Town/trajectory/ORI", [row]), 0, depth, instance)
    np.testing.assert_allclose(found, expected_m, atol=1e-4)
