"""What neighbouring pictures of a flight say of each other, from their figures alone: bounds of `release verify --level pixels`."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from cosfly.space.reprojection import Agreement
from release.verify import scene
from release.verify.findings import Findings
from release.verify.rows import FlightRows

WHOLE = Agreement(
    seen=2000, agree=2000, hidden=0, through=0, same=2000, planes=1700, shifted=0, renamed=0, error=0.0, correlation=0.97, tint=0.0, shade=0.0
)  # fmt: skip


def judged(
    found: list[Agreement], elsewhere: list[float], width_px: int = 480, rain: float = 0.0, way_px: float = 20.0,
    heights_m: list[float] | None = None,
) -> Findings:  # fmt: skip
    """What is found in a flight of which each frame says this of the one before; way_px: from each frame to the next; heights_m: of the drone
    over the person, by frame."""
    camera = {"fx": 400.0, "fy": 400.0, "cx": 240.0, "cy": 135.0}
    row = {
        "intrinsics": camera, "width_px": width_px, "height_px": 270, "weather_params": {"precipitation": rain},
        "target_mask_bbox": dict.fromkeys(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), 9.0),
    }  # fmt: skip
    rows = [{**row, "frame_index": k} for k in range(len(found) + 1)]
    for one, height_m in zip(rows, heights_m or [], strict=False):
        one |= {"pose": {"x_m": 0.0, "y_m": 0.0, "z_m": height_m, "pitch_deg": -90.0, "yaw_deg": 0.0, "roll_deg": 0.0}}
        one |= {"target": {"x_m": 0.0, "y_m": 0.0, "z_m": 0.0}}
    flight = FlightRows("run/Town/trajectory/ORI", rows, given_id="trajectory_ORI")
    findings = Findings()
    pairs = scene._Pairs(list(range(1, len(rows))), [1] * len(found), found, elsewhere, [way_px] * len(found))
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
    ("way_px", "elsewhere", "is_found"),
    [(0.5, 0.956, False), (1.9, 0.926, False), (1.9, 0.99, True), (2.1, 0.956, True), (5.7, 0.919, False)],
)
def test_frames_that_lie_on_each_other_tell_little_of_their_order(way_px, elsewhere, is_found):
    """Honest frames were better by 0.067 where the next frame lies half a pixel away, by 0.037 at 1.9 px and 0.03 farther away."""
    found, others = [WHOLE] * 20, [np.nan] * 20
    found[12], others[12] = replace(WHOLE, correlation=0.889), elsewhere
    findings = judged(found, others, 320, way_px=way_px)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found
    assert all("if it were the next frame's" in str(kind) for kind in findings.kinds.values())


@pytest.mark.parametrize(
    ("width_px", "usual", "is_found"), [(160, 0.77, False), (160, 0.6, True), (320, 0.77, True), (1280, 0.85, False)]
)
def test_the_coarser_pictures_are_the_less_their_colours_agree(width_px, usual, is_found):
    """0.77 is of an honest flight of 160 px."""
    findings = judged([replace(WHOLE, correlation=usual)] * 20, [np.nan] * 20, width_px)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(("usual", "worst", "is_found"), [(0.3, 5.5, False), (0.3, -7.0, True), (2.0, 9.0, False)])
def test_one_frame_may_not_be_brighter_than_those_beside_it(usual, worst, is_found):
    """2 and 9 are of a flight that is not known to come nearer to anything."""
    found = [replace(WHOLE, shade=usual * (-1) ** k) for k in range(20)]
    found[12] = replace(WHOLE, shade=worst)
    findings = judged(found, [np.nan] * 20)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(("odd", "is_found"), [(0.0, False), (5.5, False), (-7.0, True)])
def test_what_comes_nearer_through_fog_may_be_darker(odd, is_found):
    """2 grey levels a metre and ways of 4 m: more than one frame beside another may differ by, were it not for the fog. odd: of one frame alone."""
    heights = [24.0 + 2.0 * (-1) ** k for k in range(21)]
    found = [replace(WHOLE, shade=2.0 * (after - before)) for before, after in itertools.pairwise(heights)]
    found[12] = replace(WHOLE, shade=found[12].shade + odd)
    findings = judged(found, [np.nan] * 20, heights_m=heights)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(("usual", "way_px", "is_found"), [(0.92, 1.5, False), (0.97, 1.5, True), (0.92, 3.5, True)])
def test_pictures_that_lose_much_from_frame_to_frame_tell_little_of_their_order(usual, way_px, is_found):
    """0.92, and 0.136 better with the next one's place 1.5 px away, are of an honest flight by a renderer that smooths no edges."""
    found, others = [replace(WHOLE, correlation=usual)] * 20, [np.nan] * 20
    found[12], others[12] = replace(WHOLE, correlation=usual - 0.11), usual + 0.026
    findings = judged(found, others, 320, way_px=way_px)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(("beside", "is_found"), [(0.98, True), (0.93, False), (np.nan, False)])
def test_frames_of_little_contrast_tell_little_of_their_order(beside, is_found):
    """0.905, and 0.055 better with the next one's place, are of an honest flight by night, beside frames without contrast."""
    found, others = [replace(WHOLE, correlation=0.98)] * 30, [np.nan] * 30
    found[9:16] = [replace(WHOLE, correlation=beside)] * 7
    found[12], others[12] = replace(WHOLE, correlation=0.905), 0.96
    findings = judged(found, others, 640, way_px=5.3)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_colour"] * is_found


@pytest.mark.parametrize(("points", "is_found"), [(0, False), (34, True)])
def test_a_thing_keeps_its_id(points, is_found):
    found = [WHOLE] * 20
    found[12] = replace(WHOLE, renamed=points)
    findings = judged(found, [np.nan] * 20)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_instance"] * is_found


@pytest.mark.parametrize(("planes", "is_found"), [(300, False), (20, True)])
def test_depth_without_planes_is_found(planes, is_found):
    findings = judged([replace(WHOLE, planes=planes, error=np.nan)] * 20, [np.nan] * 20)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_depth"] * is_found
