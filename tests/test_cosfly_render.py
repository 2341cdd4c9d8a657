"""Stage 5 around the renderer, and the goals of drawn flights, which mean the target alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from public_reader import read_public
from test_renderers_contract import circling, pose_towards, street, write_inputs

from cosfly.formats.boxes import BoxMap, make_box_map
from cosfly.formats.bystanders import Bystander, Bystanders, write_bystanders
from cosfly.formats.frames import Camera, Look, frame_name, read_instance, read_meta
from cosfly.formats.inspection import read_inspection
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.people import Appearance, People
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import intrinsic_matrix, look_at, mask_box, wrap_deg
from cosfly.geometry.goals import SIDES
from cosfly.geometry.kernels import obstacle_index, signed_distances
from cosfly.inspection.settings import InspectConfig
from cosfly.inspection.stage import run as inspect_tree
from cosfly.render.camera import rendered_visibility, view_target
from cosfly.render.contract import (
    MAX_BOX_ID,
    PERSON_ID,
    SHARED_ID,
    Frame,
    PosedPerson,
    has_own_ids,
    instance_ids,
    other_id,
)
from cosfly.render.gl import meshes as unit_meshes
from cosfly.render.gl.people import person_parts
from cosfly.render.person import choose_appearance, choose_clothes, dress_bystanders, figure_of
from cosfly.render.perturbation import PerturbationConfig, Poses, Surroundings, in_frame, perturb
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import make_track_script, open_renderer, run
from cosfly.render.track import find_goal, render_track
from cosfly.runtime.config import build
from cosfly.runtime.errors import ConfigError
from cosfly.runtime.io import read_checksums

ALL_MESHES = unit_meshes.all_meshes()
CAMERA = Camera(320, 180, intrinsic_matrix(320, 180, 90.0))
SMALL = {"width_px": 160, "height_px": 90, "fovs_deg": [60.0, 90.0], "town": "Street", "first_timestamp": 1776000000}


def numbered(ids) -> BoxMap:
    places = np.zeros((len(ids), 3))
    return make_box_map(places, places + 1.0, places, np.full(len(ids), KINDS["Buildings"]), ids)


def test_instance_ids_are_the_boxes_own_where_they_fit_and_leave_those_of_others_free():
    boxes = numbered([5, MAX_BOX_ID, 1])
    assert (instance_ids(boxes).tolist(), has_own_ids(boxes)) == ([5, MAX_BOX_ID, 1], True)
    assert instance_ids(numbered([0, 1])).tolist() == [1, 2]
    ids = instance_ids(numbered(np.arange(MAX_BOX_ID + 5) + 1), num_others=20)
    others = [other_id(number) for number in range(20)]
    assert np.isin(ids, [*others, PERSON_ID, 0]).sum() == 0
    assert ids.max() == SHARED_ID
    assert (ids == SHARED_ID).sum() == 25


@given(
    st.floats(-7, 7), st.floats(0, 500), st.floats(0, 1), st.floats(-500, 500), st.floats(-20, 60), st.integers(0, 999)
)
@example(0.0, np.pi / 2, 1.0, 0.0, 0.0, 0)  # the shoes of a man in mid-stride reach the farthest
@settings(max_examples=100)
def test_the_figure_stands_on_the_ground_within_the_targets_box(heading, phase, swing, x, z, seed):
    hip = np.array([x, 3.0, z + 0.9])
    person = PosedPerson(hip, heading, phase, swing, choose_clothes(np.random.default_rng(seed)))
    figure = figure_of(person)
    records, mesh = person_parts(person, PERSON_ID, hip)
    points = []
    for k in range(len(mesh)):
        local = ALL_MESHES[mesh[k]].vertices[:, :3] * records["half"][k]
        q = records["quaternion"][k].astype(float)
        points.append(local + 2.0 * np.cross(q[:3], np.cross(q[:3], local) + q[3] * local) + figure.centers_m[k])
    offset = np.vstack(points) - hip
    assert np.abs(np.hypot(offset[:, 0], offset[:, 1])).max() < np.hypot(*PERSON_HALF_EXTENTS_M[:2]) + 0.003
    assert -0.96 < offset[:, 2].min() < -0.86, "a foot stands on the ground"
    assert 0.78 < offset[:, 2].max() < 0.93, "the head ends at 1.8 m, a woman's at 1.73"
    assert ((records["tag"] >> 16) == PERSON_ID).all()
    assert ((records["tag"] & 0xFF) == KINDS["Pedestrians"]).all()


def test_look_alikes_differ_from_the_target_in_one_thing_and_nobody_looks_just_like_it():
    target = choose_appearance(np.random.default_rng(1))
    stands = Bystander(np.zeros((2, 3)), np.zeros(2))
    others = [replace(stands, is_look_alike=True), stands] * 20
    people = dress_bystanders(others, np.arange(2) * 0.5, target, np.random.default_rng(0)).people(target)
    assert list(people.others) == [other_id(number) for number in range(40)]
    different = np.array([len(target.differences(looks)) for looks in people.others.values()])
    assert (different[::2] == 1).all()
    assert (different[1::2] >= 1).all()
    assert all(looks.is_all_seen for looks in people.others.values())
    assert different[1::2].max() > 1


def test_half_a_person_is_seen_behind_a_corner_and_nobody_hides_himself():
    hip = np.array([0.0, 10.0, 0.9])
    pose, ids = pose_towards((0, 0, 0.9), hip), np.zeros((180, 320), np.uint16)
    view = view_target(hip, pose, CAMERA)
    depth = np.where(np.arange(320) < 160, np.float32(5.0), np.float32(500.0)) + np.zeros((180, 1), np.float32)
    frame = Frame(np.zeros((180, 320, 3), np.uint8), depth, ids.astype(np.uint8), ids)
    assert rendered_visibility(frame, hip, view, pose, CAMERA)[0] == pytest.approx(0.5, abs=0.03)
    frame.ids[:, :160] = PERSON_ID
    assert rendered_visibility(frame, hip, view, pose, CAMERA) == (1.0, 0.0, 0.0)


def planned(n: int = 200, box_map=None) -> Poses:
    trace = circling(n)
    gaps, _ = signed_distances(obstacle_index(box_map or street()), trace.positions_m, 100.0)
    return Poses(trace.positions_m, trace.rotations_deg, trace.targets_m, gaps)


def perturbed(cfg: PerturbationConfig, n: int = 200, box_map=None, seed: int = 0):
    return shaken(planned(n, box_map), box_map or street(), cfg, seed)


def shaken(before: Poses, box_map: BoxMap, cfg: PerturbationConfig, seed: int = 1):
    cameras = [CAMERA] * len(before.positions_m)
    return perturb(before, cameras, Surroundings(box_map), cfg, np.random.default_rng(seed))


@pytest.mark.parametrize(("correlation_s", "num"), [(0.0, 200), (6.0, 4000)])
@pytest.mark.parametrize("sampling", ["cubic", "spherical"])
def test_perturbed_frames_keep_their_promises(sampling, correlation_s, num):
    cfg = PerturbationConfig(sampling=sampling, correlation_s=correlation_s)
    before, after = planned(num), perturbed(cfg, num)
    index = obstacle_index(street())
    moved = np.array([s["position"] == "applied" for s in after.states])
    turned = np.array([s["rotation"] == "applied" for s in after.states])
    assert 0.3 < moved.mean() <= 0.7
    assert 0.5 < turned.mean() < 0.7
    np.testing.assert_array_equal(after.is_perturbed, moved | turned)
    distances, _ = signed_distances(index, after.poses.positions_m, 100.0)
    assert (distances[moved] >= np.minimum(cfg.min_clearance_m, before.clearances_m[moved])).all()
    np.testing.assert_allclose(distances, after.poses.clearances_m)
    people, _ = signed_distances(index, after.poses.targets_m[moved])
    assert people.min() >= 0.3
    assert np.abs(after.rotation_offsets_deg).max() <= cfg.max_view_deg + 1e-9
    rolled = perturbed(cfg.model_copy(update={"max_roll_deg": 4.0}), num)
    np.testing.assert_array_equal(rolled.rotation_offsets_deg[:, :2], after.rotation_offsets_deg[:, :2])
    np.testing.assert_array_equal(rolled.poses.rotations_deg[:, 2], rolled.rotation_offsets_deg[:, 2])
    assert not after.rotation_offsets_deg[:, 2].any()
    assert 3.5 < np.abs(rolled.rotation_offsets_deg[:, 2]).max() <= 4.0
    assert (rolled.rotation_offsets_deg[~turned] == 0).all()
    order = None if sampling == "spherical" else np.inf
    reach = np.linalg.norm(after.drone_offsets_m, ord=order, axis=1)
    assert reach.max() <= cfg.drone_radius_m + 1e-9
    walked = np.linalg.norm(after.target_offsets_m[:, :2], axis=1)
    assert walked.max() <= cfg.pedestrian_radius_m * (1.0 if sampling == "spherical" else 2.0**0.5) + 1e-9
    np.testing.assert_allclose(after.poses.positions_m - before.positions_m, after.drone_offsets_m)
    np.testing.assert_allclose(after.poses.targets_m - before.targets_m, after.target_offsets_m)
    for i in np.flatnonzero(after.is_perturbed):
        assert in_frame(after.poses.targets_m[i], after.poses.positions_m[i], after.poses.rotations_deg[i], CAMERA, 0.0)
    still = ~after.is_perturbed
    np.testing.assert_array_equal(after.poses.positions_m[still], before.positions_m[still])
    np.testing.assert_array_equal(after.poses.rotations_deg[still], before.rotations_deg[still])


@pytest.mark.parametrize("sampling", ["cubic", "spherical"])
def test_smooth_perturbations_keep_probabilities_and_move_as_a_drone_and_a_walker_could(sampling):
    cfg, dt_s = PerturbationConfig(sampling=sampling, correlation_s=6.0), 0.5
    after = perturbed(cfg, 4000)
    drawn = np.array([[state["position"] != "none", state["rotation"] != "none"] for state in after.states])
    np.testing.assert_allclose(drawn.mean(axis=0), [0.6, 0.6], atol=0.1)
    order = None if sampling == "spherical" else np.inf
    walked_m = after.target_offsets_m[:, :2]
    for offsets_m, radius_m in ((after.drone_offsets_m, cfg.drone_radius_m), (walked_m, cfg.pedestrian_radius_m)):
        assert 0.8 * radius_m < np.linalg.norm(offsets_m, ord=order, axis=1).max() <= radius_m + 1e-9
        steps = np.diff(offsets_m, axis=0)
        speeds_mps = np.linalg.norm(steps, axis=1) / dt_s
        accelerations_mps2 = np.linalg.norm(np.diff(steps, axis=0), axis=1) / dt_s**2
        assert speeds_mps.max() < 2.5
        assert np.percentile(accelerations_mps2, 95) < 1.5


def test_a_smooth_perturbation_fades_before_it_falls_back():
    before, wall = along_a_wall(4.0)
    cfg = PerturbationConfig(correlation_s=4.0, position_probability=1.0, rotation_probability=0.0, drone_radius_m=6.0)
    after, again = (shaken(before, wall, cfg) for _ in range(2))
    states = [state["position"] for state in after.states]
    assert {"applied", "fallback: drone clearance"} <= set(states)
    reach_m = np.linalg.norm(after.drone_offsets_m, axis=1)
    assert not reach_m[[state != "applied" for state in states]].any()
    assert reach_m.max() > 2.0
    assert np.linalg.norm(np.diff(after.drone_offsets_m, axis=0), axis=1).max() < 1.5
    np.testing.assert_array_equal(after.poses.positions_m, again.poses.positions_m)
    assert after.states == again.states


def test_a_smooth_shift_turns_no_camera_round_over_its_target():
    n = 400
    targets = np.column_stack([0.5 * np.arange(n), np.zeros(n), np.full(n, 0.9)])
    drones = targets + np.array([-3.0, 0.0, 20.0])
    pitch, yaw = look_at(drones, targets)
    before = Poses(drones, np.degrees(np.stack([pitch, yaw, 0.0 * yaw], axis=1)), targets, np.full(n, 20.0))
    cfg = PerturbationConfig(correlation_s=2.0)
    after = shaken(before, make_box_map([], [], [], []), cfg, 0)
    assert "fallback: yaw rate" in {state["position"] for state in after.states}
    assert np.abs(wrap_deg(np.diff(after.poses.rotations_deg[:, 1]))).max() / 0.5 <= 60.0


def test_the_four_states_come_in_the_papers_shares():
    """tab:augmentation_states: 16, 24, 24 and 36 %, before fallbacks."""
    states = perturbed(PerturbationConfig(), 3000).states
    drawn = np.array([[s["position"] != "none", s["rotation"] != "none"] for s in states])
    shares = [np.mean((drawn == pattern).all(axis=1)) for pattern in ([0, 0], [1, 0], [0, 1], [1, 1])]
    np.testing.assert_allclose(shares, [0.16, 0.24, 0.24, 0.36], atol=0.03)


def along_a_wall(gap_m: float) -> tuple[Poses, BoxMap]:
    """A flight along a wall of 40 m, `gap_m` beside it all the way, and the wall."""
    n = 120
    t = np.arange(n) * 0.5
    targets = np.stack([0.5 * t, np.full(n, 20.0), np.full(n, 0.9)], axis=1)
    drones = targets + np.array([-4.0, -20.0, 19.1])
    pitch, yaw = look_at(drones, targets)
    rotations = np.degrees(np.stack([pitch, yaw, 0.0 * pitch], axis=1))
    wall = make_box_map([[10.0, -gap_m - 1.0, 20.0]], [[60.0, 1.0, 20.0]], [[0.0, 0.0, 0.0]], [KINDS["Walls"]])
    return Poses(drones, rotations, targets, np.full(n, gap_m)), wall


@pytest.mark.parametrize(("gap_m", "least_m"), [(12.0, 3.0), (4.0, 3.0), (3.0, 3.0), (2.5, 2.5)])
def test_a_whole_flight_along_a_planted_wall_keeps_the_planners_clearance(gap_m, least_m):
    """3.0 m, or as near as the plan itself where that flies at its relaxed floor of 2.5 m; far from the wall nothing
    falls back."""
    before, wall = along_a_wall(gap_m)
    after = shaken(before, wall, PerturbationConfig())
    distances, _ = signed_distances(obstacle_index(wall), after.poses.positions_m, 100.0)
    assert distances.min() >= least_m - 1e-9
    moved = [state["position"] for state in after.states]
    assert moved.count("applied") > 0.15 * len(moved)
    assert ("fallback: drone clearance" in moved) == (gap_m < 6.0)
    careless = shaken(before, wall, PerturbationConfig(min_clearance_m=0.6))
    assert (careless.poses.clearances_m.min() < 2.5) == (gap_m < 6.0), "or the wall would prove nothing"


def test_the_tree_is_complete_and_readable_and_shows_what_its_annotation_says(tmp_path):
    """The inspection checks files, digests, masks, depths and boxes against poses."""
    flights = [circling(5), circling(5, "path_001", "not_visible"), circling(4, "path_002")]
    boxes, simplified, traces = write_inputs(tmp_path / "in", flights)
    tree = run(build(RenderConfig, SMALL, "test"), boxes, simplified, traces, tmp_path / "out", seed=5)
    assert len(read_public(tree)) == 2  # the strictest public reader
    folders = find_tracks(tree)
    names = [str(f.relative_to(tree)) for f in folders]
    assert names == [f"Town_Street/trajectory_{1776000000 + k}/{v}" for k in (0, 2) for v in ("ORI", "aug_001")]
    loose = {"five_ray_mean_min": 0, "clearance_min_m": 0, "legible_min": 0}  # a hand-made flight of a small person
    found = read_inspection(inspect_tree(InspectConfig(**loose), simplified, traces, tree, tmp_path / "inspect"))
    assert [issue for one in found.flights for issue in one.issues if issue.severity == "error"] == []
    for folder in folders:
        flight = read_track(folder)  # strict
        assert flight.is_original == (folder.name == "ORI")
        on_disk = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} - {"checksums.sha256"}
        assert set(read_checksums(folder)) == on_disk
        for i in range(len(flight)):
            frame = flight.frame_folder(i)
            meta, ids = read_meta(frame), read_instance(frame)[1]
            assert (meta.index, meta.variant) == (i, folder.name)
            assert meta.target.num_pixels == int((ids == PERSON_ID).sum()) > 0
            assert meta.target.visible == bool(flight.target.visible[i])
            assert meta.target.visibility == pytest.approx(flight.target.visibility[i], abs=1e-6)
            box = mask_box(ids == PERSON_ID).tolist()
            assert meta.target.mask_bbox_2d == flight.target.mask_bbox[i].tolist() == box
            tree_y = json.loads((frame / "meta.json").read_text())["drone_pose"]["y"]
            told_y = pytest.approx(-flight.positions_m[i, 1])
            assert tree_y == -meta.drone_pose[1] == told_y, "the tree's axes are CARLA's"
            assert meta.look == Look(), "sun and air of the picture"
            assert meta.camera.intrinsic == flight.camera.intrinsic.tolist()
    manifest = json.loads((tree / "manifest.json").read_text())
    assert manifest["counts"] == {"input": 4, "kept": 4, "dropped": {}, "failed": {}}
    assert (manifest["num_traces"], manifest["num_traces_not_rendered"], manifest["num_frames"]) == (3, 1, 18)


class Curtain:
    """A renderer of a map with one thing in it: whoever stands beyond `x_m` is hidden."""

    dresses, device = False, "none"

    def __init__(self, x_m: float) -> None:
        self.x_m, self.num_drawn = x_m, 0

    def prepare(self, low_m, high_m, weather=None) -> None: ...

    def close(self) -> None: ...

    def render(self, camera_pose, intrinsic, people) -> Frame:
        self.num_drawn += 1
        shape, is_hidden = (CAMERA.height_px, CAMERA.width_px), people[PERSON_ID].hip_m[0] > self.x_m
        ids = np.full(shape, 0 if is_hidden else PERSON_ID, dtype=np.uint16)
        depth = np.full(shape, 0.5 if is_hidden else 1000.0, dtype=np.float32)
        return Frame(np.zeros((*shape, 3), np.uint8), depth, np.zeros(shape, np.uint8), ids)


def test_a_shift_that_hides_a_seen_target_falls_back(tmp_path):
    trace, around = circling(60), Surroundings(make_box_map([], [], [], []))
    size = {"width_px": CAMERA.width_px, "height_px": CAMERA.height_px, "fovs_deg": (90.0,)}
    cfg = RenderConfig(**size, first_timestamp=1_776_000_000, modalities=("rgb",))
    script = make_track_script(trace, 0, "perturbed", "T", around, cfg, 1)
    curtain = Curtain(x_m=float(trace.targets_m[30, 0]))
    flight = render_track(curtain, script, tmp_path, cfg)
    is_seen = trace.targets_m[:, 0] <= curtain.x_m
    np.testing.assert_array_equal(flight.target.visible | ~is_seen, True)
    states = [point["perturbation"] for point in flight.raw["points"]]
    fell_back = [i for i in range(60) if states[i]["position"] == "fallback: target hidden"]
    assert fell_back, "the curtain hid nobody"
    without = script.perturbed.unshifted
    for i in fell_back:
        assert script.perturbed.poses.targets_m[i, 0] > curtain.x_m
        assert states[i]["rotation"] == without.states[i]["rotation"]
        np.testing.assert_array_equal(flight.targets_m[i], trace.targets_m[i])
        np.testing.assert_array_equal(flight.positions_m[i], trace.positions_m[i])
        np.testing.assert_array_equal(flight.rotations_deg[i], without.poses.rotations_deg[i])
        assert not flight.perturbation.drone_m[i].any()
        assert read_meta(tmp_path / frame_name(i)).perturbation.position == "fallback: target hidden"
    assert any(states[i]["position"] == "applied" for i in range(60) if not is_seen[i])
    assert curtain.num_drawn - 60 >= len(fell_back)
    assert make_track_script(trace, 0, "perturbed", "T", around, cfg, 1).perturbed.states == script.perturbed.states


def test_a_walled_in_person_is_not_moved():
    start = planned(1).targets_m[0]
    cage = make_box_map(
        start + 0.75 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]),
        [[0.4, 4, 2], [0.4, 4, 2], [4, 0.4, 2], [4, 0.4, 2]], np.zeros((4, 3)), [KINDS["Walls"]] * 4,
    )  # fmt: skip
    cfg = PerturbationConfig(position_probability=1.0, pedestrian_radius_m=1.0)
    found = [perturbed(cfg, 1, cage, seed) for seed in range(30)]
    outcomes = {f.states[0]["position"] for f in found}
    assert "fallback: person in an obstacle" in outcomes
    for f in (f for f in found if f.states[0]["position"] == "applied"):
        assert signed_distances(obstacle_index(cage), f.poses.targets_m)[0].min() >= 0.3


LOOKS = Appearance("man", "jacket", "blue", "trousers", "red")


@pytest.mark.parametrize(("y_m", "says_legs"), [(8.0, True), (-8.0, False)])
def test_what_a_wall_hides_is_not_said(y_m, says_legs):
    """Two men whose trousers alone differ; to the south of them is a wall as high as their hips."""
    people = People(LOOKS, {other_id(0): replace(LOOKS, legs_color="yellow")})
    clothes = choose_clothes(np.random.default_rng(0), LOOKS)
    wall = make_box_map([[0.0, -1.5, 0.5]], [[9.0, 0.1, 0.5]], [[0.0] * 3], [KINDS["Walls"]])
    intrinsic, renderer = intrinsic_matrix(320, 180, 60.0), open_renderer("gl", wall, 320, 180, num_others=1)
    hips_m, (low_m, high_m) = np.array([[0.0, 0.0, 0.9], [1.5, 0.0, 0.9]]), np.array([[-30.0] * 3, [30.0] * 3])
    renderer.prepare(low_m, high_m)
    pose = pose_towards([0.2, y_m, 1.3], hips_m[0])

    def draw(number: int, looks: Appearance) -> Frame:
        both = {PERSON_ID: LOOKS, **people.others} | {number: looks}
        dressed = [replace(clothes, looks=one) for one in both.values()]
        bodies = [PosedPerson(hip_m, 0.0, 0.5, 1.0, one) for hip_m, one in zip(hips_m, dressed, strict=True)]
        return renderer.render(pose, intrinsic, dict(zip(both, bodies, strict=True)))

    goal = find_goal(people, 3, draw, 8)
    renderer.close()
    assert goal is not None
    assert (goal.frame, "legs" in goal.says) == (3, says_legs)
    assert bool({*goal.says} & {*SIDES}) != says_legs  # where they are hidden, a place is said


@pytest.fixture(scope="session")
def crowded_tree(built_once):
    """Two walks, both tracks, each among eight bystanders of whom four look alike the target but for one thing."""

    def make(folder):
        traces = [circling(3, f"path_{k:03d}") for k in range(2)]
        places_m = [[x, y, -0.9] for x in (-4.0, -1.5, 1.0, 3.5) for y in (-2.0, 2.0)]
        crowds = [[Bystander(t.targets_m + place_m, np.zeros(3)) for place_m in places_m] for t in traces]
        alike = [[replace(one, is_look_alike=k < 4) for k, one in enumerate(crowd)] for crowd in crowds]
        others = [Bystanders(t.path_id, crowd) for t, crowd in zip(traces, alike, strict=True)]
        write_bystanders(folder / "others.json", others, {})
        cfg = build(RenderConfig, {"width_px": 320, "height_px": 180, "fovs_deg": [60.0]}, "test")
        run(cfg, *write_inputs(folder / "in", traces), folder / "out", seed=2, others=folder / "others.json")

    return built_once("crowd", make) / "out"


def test_a_town_that_is_a_path_is_refused():
    with pytest.raises(ConfigError, match="letters"):
        build(RenderConfig, {"town": "../x"}, "test")
