"""Styles: what the table says is what is drawn, flown by every planner, and seen in the labels."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from specimens_planning import WORLDS, assert_safe, town_flights, town_of, track_of, walk_along

from caption.schema import WindowConfig
from caption.stage.windows import cut_windows
from caption.verification.actions import TABLE as ACTION_TABLE
from caption.verification.actions import measure
from cosfly.formats.captions import TOKENS
from cosfly.formats.frames import LEGIBLE_HEIGHT_PX
from cosfly.formats.pedestrian_paths import paces_of
from cosfly.formats.traces import DroneTrace
from cosfly.geometry import kernels
from cosfly.geometry.axes import look_at, wrap_deg
from cosfly.pipeline.settings import RunConfig
from cosfly.planners.contract import PLANNERS, PlanConfig
from cosfly.planners.reference_trajectory import finds_again
from cosfly.planners.stage import plan_trajectory
from cosfly.planners.styles import FOLLOW, NAMES, REACQUIRE, RETURN_HOME, TABLE
from cosfly.runtime.config import load, shipped

OPEN = kernels.obstacle_index(town_of())
STRAIGHT = walk_along("straight", [(0, 0), (90, 0)])
# Who jogs for 5 s and stands for 4 s.
ALONG_M = 2.4 * np.cumsum(np.arange(180) % 18 < 10) * 0.5
HALTING = replace(
    walk_along("halting", [(0, 0), (89.5, 0)], speed_mps=1.0),
    positions_m=np.column_stack([ALONG_M[:179], np.zeros((179, 2))]), speeds_mps=2.4 * (np.arange(179) % 18 < 10),
)  # fmt: skip
# A long house beside the walk hides a low drone on its other side for a while.
HOUSE = kernels.obstacle_index(town_of(((45, 12, 14), (16, 6, 14)), ((45, -12, 14), (16, 6, 14))))


def styled(name, **more):
    return PlanConfig(styles={name: 1}, **more)


def labels_of(trace):
    """The labels of a flight's windows; what the camera does not look at is not seen."""
    windows = cut_windows(track_of(trace, (640, 360), 60.0), WindowConfig(require_images=False))
    return Counter(ACTION_TABLE.label_of(measure(window.future)) for window in windows)


@pytest.mark.parametrize("name", TABLE)
def test_a_style_shows_the_decisions_that_it_is_for(name):
    counts = Counter()
    for seed in range(3):
        walk = HALTING if TABLE[name].suits == "uneven" else STRAIGHT
        trace = plan_trajectory(walk, OPEN, styled(name, planner="muco"), seed)
        assert trace.drop_reason is None
        assert [part.style for part in trace.segments] == [name]
        counts += labels_of(trace)
    share = {label: number / counts.total() for label, number in counts.items()}
    assert sum(share.get(label, 0) for label in TABLE[name].purpose) >= 0.3
    assert len(TABLE[name].purpose) == 1 or all(label in share for label in TABLE[name].purpose if "_left" not in label)


@pytest.mark.slow
@pytest.mark.parametrize("style", NAMES)
@pytest.mark.parametrize("planner", PLANNERS)
def test_every_planner_flies_every_style_safely(planner, style):
    box_map, corners = WORLDS["corner"]
    obstacles, walk = kernels.obstacle_index(box_map), walk_along("w", corners)
    cfg = styled(style, planner=planner, altitude_min_m=8.0, track_astar={"beam": 512})
    trace = plan_trajectory(walk, obstacles, cfg, 0)
    assert_safe(trace.positions_m, obstacles, cfg)
    assert trace.drop_reason in (None, "style_not_held", "no_hiding_place", "not_lost_and_found")
    if planner == "muco":  # what is drawn does not depend on who flies it
        again = plan_trajectory(walk, obstacles, cfg, 0)
        np.testing.assert_array_equal(trace.positions_m, again.positions_m)
        assert trace.segments == again.segments
    assert trace.as_json() == DroneTrace.from_json(trace.as_json(), "w").as_json()
    if style == FOLLOW:
        assert trace.as_json().keys().isdisjoint({"segments", "mission", "instead_of"})


def test_parts_draw_their_styles_and_cover_the_flight():
    cfg = PlanConfig(styles={"side": 1, "rise": 1, "hold": 0}, segment_s=15)
    trace = plan_trajectory(STRAIGHT, OPEN, cfg, 1)
    assert {part.style for part in trace.segments} == {"side", "rise"}
    assert trace.segments[0].begin == 0
    assert [a.end for a in trace.segments[:-1]] == [b.begin for b in trace.segments[1:]]
    assert trace.segments[-1].end == len(trace.time_s)


@pytest.mark.parametrize("planner", ["muco", "foresight", "track_astar"])
def test_an_orbit_is_flown_at_the_requested_distance(planner):
    """TA*+Smooth moves by one voxel a layer: it cuts fast orbits, which are not held, and holds slower ones."""
    at = {"style_ranges": {"orbit_left": {"ground_distance_m": (14.5, 14.5), "altitude_m": (12.0, 12.0)}}}
    trace = plan_trajectory(STRAIGHT, OPEN, styled("orbit_left", planner=planner, **at), 0)
    assert trace.drop_reason is None
    away_m = np.hypot(*(trace.positions_m - trace.targets_m)[:, :2].T)
    assert (np.abs(away_m - 14.5) <= 0.15 * 14.5).mean() >= 0.7


def test_a_style_that_the_map_does_not_hold_is_dropped_or_followed_and_says_why():
    dropped = plan_trajectory(STRAIGHT, OPEN, styled(REACQUIRE), 0)
    assert dropped.drop_reason == "no_hiding_place"
    instead = plan_trajectory(STRAIGHT, OPEN, styled(REACQUIRE, styles_fallback="follow"), 0)
    assert (instead.drop_reason, instead.instead_of) == (None, "reacquire: no_hiding_place")
    np.testing.assert_array_equal(instead.positions_m, plan_trajectory(STRAIGHT, OPEN, PlanConfig(), 0).positions_m)
    # Towers all along leave an orbit no room; a planner that searches may hold it from above them.
    towers = [((x, side * 13, 40), (12, 8, 40)) for x in range(-40, 140, 25) for side in (-1, 1)]
    walled = kernels.obstacle_index(town_of(*towers))
    by_muco = plan_trajectory(STRAIGHT, walled, styled("orbit_left", planner="muco"), 0)
    assert by_muco.drop_reason in ("style_not_held", "low_visibility")
    fallback = styled("orbit_left", planner="muco", styles_fallback="follow")
    assert plan_trajectory(STRAIGHT, walled, fallback, 0).drop_reason is None


def heights_px(trace, cfg):
    """Of the target in every tenth frame that has it in view, at each field of view."""
    for fov_deg in cfg.fovs_deg:
        target = track_of(trace, (cfg.width_px, cfg.height_px), fov_deg).target
        box = target.bbox[::10][target.in_view[::10]]
        yield from box[:, 3] - box[:, 1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_diverse_shows_each_decision_and_all_heights_and_distances_whatever_the_seed(seed):
    cfg = load(RunConfig, shipped("diverse.yaml"), [f"seed={seed}"])
    towns = [cfg.of_town(name) for name in cfg.towns]
    flights = (one for town in towns for one in town_flights(town, paces_of(10, town.pedestrians.pace, town.seed)))
    kept = [trace for trace in flights if trace.drop_reason is None]
    assert len(kept) >= 78
    labels = sum(map(labels_of, kept), Counter())
    for name in set(TOKENS) - {"break_off", "return_to_home"}:
        assert labels[name] >= 0.02 * labels.total(), (name, labels)
    for over, low_m, high_m in ((2, 10, 50), (3, 12, 50)):
        away = np.concatenate([trace.positions_m - trace.targets_m for trace in kept])
        found_m = away[:, 2] + 0.9 if over == 2 else np.linalg.norm(away, axis=1)
        assert np.percentile(found_m, 5) <= low_m
        assert np.percentile(found_m, 95) >= high_m
    styles = Counter(part.style for trace in kept for part in trace.segments for _ in range(part.begin, part.end))
    assert max(styles.values()) <= 0.3 * sum(len(trace.time_s) for trace in kept)
    assert styles["hold"] > 0
    assert sum(trace.segments[0].style == REACQUIRE for trace in kept if trace.segments) >= 1
    assert min(trace.metrics["clearance_min_m"] for trace in kept) >= 3.0 - 1e-3
    assert np.concatenate([trace.visibility for trace in kept]).mean() >= 0.9
    assert np.mean([px < LEGIBLE_HEIGHT_PX for trace in kept for px in heights_px(trace, cfg.render)]) <= 0.05


def test_reacquire_loses_the_walker_and_finds_again_and_looks_where_it_lost_it():
    traces = [plan_trajectory(STRAIGHT, HOUSE, styled(REACQUIRE), seed) for seed in range(6)]
    trace = max((trace for trace in traces if trace.drop_reason is None), key=lambda t: (t.visibility == 0).sum())
    assert finds_again(trace.visibility, 0.5)
    assert not trace.segments[0].keeps_sight
    lost = np.flatnonzero(trace.visibility == 0)
    yaw = look_at(trace.positions_m, trace.targets_m)[1]
    aside = np.abs(wrap_deg(np.degrees(yaw) - trace.rotations_deg[:, 1]))
    assert aside[lost].max() > 3  # nobody tells it where the walker is
    assert aside[trace.visibility > 0].max() < 1e-3
    assert labels_of(trace)["search_to_reacquire_target"] >= 2


def test_a_mission_ends_the_pursuit_at_home_and_looks_ahead():
    trace = plan_trajectory(STRAIGHT, OPEN, styled(RETURN_HOME), 3)
    mission = trace.mission
    assert trace.drop_reason is None
    assert [part.style for part in trace.segments] == [FOLLOW, RETURN_HOME]
    assert trace.segments[0].end == trace.segments[1].begin == mission.at_frame
    assert 0 < mission.at_frame < mission.home_frame < len(trace.time_s)
    assert np.linalg.norm(trace.positions_m[-1, :2] - mission.home_m[:2]) < 6
    flown = np.diff(trace.positions_m, axis=0)[mission.home_frame + 4 : -4]
    course_deg = np.degrees(np.arctan2(flown[:, 1], flown[:, 0]))
    is_under_way = np.hypot(flown[:, 0], flown[:, 1]) > 1.0
    turned = np.abs(wrap_deg(course_deg - trace.rotations_deg[mission.home_frame + 4 : -5, 1]))
    assert turned[is_under_way].max() < 25
    assert np.abs(wrap_deg(np.diff(trace.rotations_deg[:, 1]))).max() <= 45.0 * 0.5 + 1e-6  # it turns, it does not jump
    assert np.abs(np.diff(trace.rotations_deg[mission.at_frame :, 0])).max() <= 45.0 * 0.5 + 1e-6
    assert trace.metrics["five_ray_mean"] == 1.0  # of the pursuit alone
    found = [mission.order_at(i) for i in (mission.at_frame - 1, mission.at_frame, mission.home_frame)]
    assert found == [None, "break_off", "return_to_home"]


@pytest.mark.parametrize("planner", PLANNERS)
def test_the_way_home_arrives_and_holds_past_what_stands_between(planner):
    tower = kernels.obstacle_index(town_of(((20, 20, 60), (8, 8, 60))))
    walk = walk_along("round", [(0, 0), (50, 0), (50, 50)])
    trace = plan_trajectory(walk, tower, styled(RETURN_HOME, planner=planner, track_astar={"beam": 256}), 0)
    assert trace.drop_reason is None
    assert trace.mission.at_frame >= len(trace.time_s) / 3
    speeds = np.linalg.norm(np.diff(trace.positions_m, axis=0), axis=1) / 0.5
    assert np.linalg.norm(trace.positions_m[-5:] - trace.mission.home_m, axis=1).max() < 0.5
    assert speeds[-4:].max() < 0.3
    assert speeds[trace.mission.home_frame :].max() <= 6.5
    assert np.linalg.norm(np.diff(trace.positions_m, n=2, axis=0), axis=1).max() / 0.25 <= 5.0 + 1e-6
    assert trace.metrics["clearance_min_m"] >= 2.5 - 1e-3
