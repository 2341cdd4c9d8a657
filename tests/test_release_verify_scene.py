"""What neighbouring pictures of a flight say of each other, from their figures alone: bounds of `release verify --level pixels`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosfly.reprojection import Agreement
from release.verify import scene
from release.verify.findings import Findings
from release.verify.rows import FlightRows


@pytest.mark.parametrize(
    ("rain", "worst", "is_found"), [(0.0, 0.81, True), (10.0, 0.81, True), (80.0, 0.81, False), (80.0, 0.75, True)]
)
def test_colours_may_differ_more_from_frame_to_frame_where_it_rains(rain, worst, is_found):
    camera = {"fx": 400.0, "fy": 400.0, "cx": 240.0, "cy": 135.0}
    sky, box = {"precipitation": rain}, dict.fromkeys(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), 9.0)
    flight = FlightRows(
        "run/Town/trajectory/ORI",
        [
            {
                "frame_index": k,
                "intrinsics": camera,
                "width_px": 480,
                "height_px": 270,
                "weather_params": sky,
                "target_mask_bbox": box,
            }
            for k in range(21)
        ],
        given_id="trajectory_ORI",
    )
    whole = Agreement(
        seen=2000,
        agree=2000,
        hidden=0,
        through=0,
        same=2000,
        error=0.0,
        correlation=0.97,
        tint=0.0,
        shade=0.0,
        shifted=0,
    )
    found = [whole] * 20
    found[12] = replace(whole, correlation=worst)
    findings = Findings()
    scene._judge(flight, scene._Pairs(list(range(1, 21)), [1] * 20, found, [np.nan] * 20), "float32", findings)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found
