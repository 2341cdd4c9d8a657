"""What neighbouring pictures of a flight say of each other, from their figures alone: bounds of `release verify --level pixels`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosfly.reprojection import Agreement
from release.verify import scene
from release.verify.findings import Findings
from release.verify.rows import FlightRows

WHOLE = Agreement(
    seen=2000, agree=2000, hidden=0, through=0, same=2000, planes=1700, shifted=0, error=0.0, correlation=0.97, tint=0.0, shade=0.0
)  # fmt: skip


def judged(found: list[Agreement], elsewhere: list[float], width_px: int = 480, rain: float = 0.0) -> Findings:
    """What is found in a flight of which each frame says this of the one before."""
    camera = {"fx": 400.0, "fy": 400.0, "cx": 240.0, "cy": 135.0}
    row = {
        "intrinsics": camera, "width_px": width_px, "height_px": 270, "weather_params": {"precipitation": rain},
        "target_mask_bbox": dict.fromkeys(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), 9.0),
    }  # fmt: skip
    rows = [{**row, "frame_index": k} for k in range(len(found) + 1)]
    flight = FlightRows("run/Town/trajectory/ORI", rows, given_id="trajectory_ORI")
    findings = Findings()
    pairs = scene._Pairs(list(range(1, len(rows))), [1] * len(found), found, elsewhere)
    scene._judge(flight, pairs, "float32", findings)
    return findings


@pytest.mark.parametrize(
    ("rain", "worst", "is_found"), [(0.0, 0.81, True), (10.0, 0.81, True), (80.0, 0.81, False), (80.0, 0.75, True)]
)
def test_colours_may_differ_more_from_frame_to_frame_where_it_rains(rain, worst, is_found):
    found = [WHOLE] * 20
    found[12] = replace(WHOLE, correlation=worst)
    findings = judged(found, [np.nan] * 20, rain=rain)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(
    ("width_px", "elsewhere", "is_found"), [(320, 0.958, False), (320, 0.97, True), (1280, 0.958, True)]
)
def test_the_next_frames_place_must_explain_coarse_colours_better_to_be_theirs(width_px, elsewhere, is_found):
    """0.921 and 0.958 are of an honest flight of 320 px."""
    found, others = [WHOLE] * 20, [np.nan] * 20
    found[12], others[12] = replace(WHOLE, correlation=0.921), elsewhere
    findings = judged(found, others, width_px)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found
    assert all("if it were the next frame's" in str(kind) for kind in findings.kinds.values())


@pytest.mark.parametrize(("usual", "worst", "is_found"), [(0.3, 5.5, False), (0.3, -7.0, True), (2.0, 9.0, False)])
def test_one_frame_may_not_be_brighter_than_those_beside_it(usual, worst, is_found):
    """2 and 9 are of an honest flight in dense fog."""
    found = [replace(WHOLE, shade=usual * (-1) ** k) for k in range(20)]
    found[12] = replace(WHOLE, shade=worst)
    findings = judged(found, [np.nan] * 20)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(("planes", "is_found"), [(300, False), (20, True)])
def test_depth_without_planes_is_found(planes, is_found):
    findings = judged([replace(WHOLE, planes=planes, error=np.nan)] * 20, [np.nan] * 20)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_depth"] * is_found
