"""Inspection: clean flights pass, every planted defect is found and named, and the funnel adds up."""

import contextlib
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cosfly.formats.boxes import read_boxes, write_boxes
from cosfly.formats.frames import BystanderMeta, BystandersMeta, depth_file, frame_name, read_depth, read_instance
from cosfly.formats.inspection import read_inspection
from cosfly.formats.issues import Report
from cosfly.formats.kinds import KINDS
from cosfly.formats.playback_file import read_track
from cosfly.formats.traces import DroneTrace, write_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import mask_box, wrap_deg
from cosfly.geometry.kernels import obstacle_index, signed_distances
from cosfly.inspection.frames import check_bystanders
from cosfly.inspection.pixels import NUM_IDS, Picture, measure_pixels
from cosfly.inspection.settings import InspectConfig
from cosfly.inspection.stage import run
from cosfly.inspection.track import check_plan
from cosfly.runtime.errors import NothingKept
from cosfly.runtime.io import CHECKSUMS, sha256_file, write_checksums
from cosfly.runtime.json_io import read_json
from specimens import change_json, make_playback_tree, map_of

NUM_POINTS = 10


def plan_of(folder: Path) -> DroneTrace:
    flight = read_track(folder)
    n = len(flight)
    return DroneTrace(
        flight.source["scenario_id"], "muco", flight.time_s, flight.positions_m, flight.rotations_deg, flight.targets_m,
        np.full(n, 0.9), np.full(n, 5.0),
    )  # fmt: skip


def write_map(workplace: Path, *boxes) -> None:
    road = ("Roads", (0.0, 900.0, -1.0), (9.0, 9.0, 0.1))
    write_boxes(workplace / "map.json", map_of(road, *(("Walls", *box) for box in boxes)))


def list_files(tree: Path) -> None:
    for folder in find_tracks(tree):
        files = [p for p in folder.rglob("*") if p.is_file() and p.name != CHECKSUMS]
        write_checksums(folder, {p.relative_to(folder).as_posix(): sha256_file(p) for p in files})


@pytest.fixture(scope="module")
def specimen(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("specimen")
    tree = make_playback_tree(root / "tree", num_flights=2, num_points=NUM_POINTS, width_px=192, height_px=108)
    list_files(tree)
    plans = [plan_of(folder) for folder in find_tracks(tree) if folder.name == "ORI"]
    write_traces(root / "drone_trace.json", plans, {})
    write_map(root)
    return root


@pytest.fixture
def workplace(specimen, tmp_path) -> Path:
    shutil.copytree(specimen, tmp_path / "w")
    return tmp_path / "w"


# The specimen's drone is jerkier than a planned one, so the plan's rules get their own tests below.
CFG = InspectConfig(accel_rms_max_mps2=50, jerk_rms_max_mps3=200, smoothness_min=0)
NO_SUMS = CFG.model_copy(update={"check_checksums": False})


def inspect(workplace: Path, cfg: InspectConfig = CFG, out: str = "out", **more):
    return read_inspection(
        run(cfg, workplace / "map.json", workplace / "drone_trace.json", workplace / "tree", workplace / out, **more)
    )


def first_flight(workplace: Path, variant: str = "ORI") -> Path:
    return next(f for f in find_tracks(workplace / "tree") if f.name == variant)


def codes_of(inspection, folder: Path) -> dict[str, str]:
    name = "/".join(folder.parts[-3:])
    flight = next(f for f in inspection.flights if f.folder == name)
    return {issue.code: issue.severity for issue in flight.issues}


def test_clean_flights_are_accepted(workplace):
    found = inspect(workplace)
    assert [f.result for f in found.flights] == ["accepted"] * 4, [f.issues for f in found.flights]
    assert found.funnel.trajectories.model_dump() == {
        "planned": 2, "dropped": {}, "not_rendered": 0, "rendered": 2, "accepted": 2, "review": 0, "rejected": 0,
    }  # fmt: skip
    metrics = found.flights[0].metrics
    flight = read_track(first_flight(workplace))
    assert metrics["rendered_visibility_mean"] == pytest.approx(flight.target.visibility.mean(), abs=1e-4)
    assert metrics["num_frames_checked"] == NUM_POINTS
    assert 0.5 < metrics["track_quality"] <= 1.0  # the specimen's person fills its box


def test_what_a_tree_was_never_to_have_is_not_missing(workplace):
    """Colours alone were drawn (`render.modalities`): the checksums list nothing else. Files that they list were
    lost."""
    lost, never = find_tracks(workplace / "tree")[:2]
    for folder in (lost, never):
        for path in [*folder.rglob("depth.npy"), *folder.rglob("instance.png")]:
            path.unlink()
    list_files(never)
    found = inspect(workplace)
    assert codes_of(found, lost)["missing_file"] == "error"
    assert codes_of(found, never) == {"not_in_this_tree": "note"}


def planned_as(
    cfg: InspectConfig, most_degps: float, *, zigzag_m=0.0, turn_deg=0.0, drop_reason=None
) -> dict[str, str]:
    """What is said of a plan that goes east at 2 m/s, with a zigzag along the way and turns of its camera."""
    n, report = 40, Report()
    positions, rotations = np.zeros((2, n, 3))
    positions[:, 0] = np.arange(n) + zigzag_m * (np.arange(n) % 2)
    rotations[:, 1] = wrap_deg(170.0 + turn_deg * np.arange(n))  # across the seam at 180 degrees
    trace = DroneTrace(
        "p", "muco", np.arange(n) * 0.5, positions, rotations, positions, np.full(n, 0.9), np.ones(n),
        drop_reason=drop_reason,
    )  # fmt: skip
    check_plan(trace, cfg, report, {}, most_degps)
    return {issue.code: issue.severity for issue in report.issues}


@pytest.mark.parametrize(("change", "code", "severity"), [
    ({"zigzag_m": 3.0}, "acceleration", "error"),
    ({"zigzag_m": 3.0}, "jerk", "error"),
    ({"zigzag_m": 1.0}, "smoothness", "warning"),
    ({"turn_deg": 40.0}, "yaw_rate", "error"),
    ({"drop_reason": "low_visibility"}, "prefiltered", "error"),
])  # fmt: skip
def test_plan_rules(change, code, severity):
    assert planned_as(InspectConfig(), 60.0, **change).get(code) == severity
    off = InspectConfig(accel_rms_max_mps2=1e6, jerk_rms_max_mps3=1e6, smoothness_min=0)
    assert planned_as(off, 90.0, **change).keys() <= {"prefiltered"}


def findings(workplace: Path, cfg: InspectConfig = CFG) -> dict[str, dict[str, str]]:
    shutil.rmtree(workplace / "out", ignore_errors=True)
    with contextlib.suppress(NothingKept):  # then the records say why
        inspect(workplace, cfg)
    found = read_inspection(workplace / "out" / "inspect.json")
    return {variant: codes_of(found, first_flight(workplace, variant)) for variant in ("ORI", "aug_001")}


def test_each_track_is_measured_against_the_map_by_its_own_poses(workplace):
    clean, shaken = (read_track(first_flight(workplace, variant)) for variant in ("ORI", "aug_001"))
    i = int(np.argmax(np.linalg.norm(shaken.positions_m - clean.positions_m, axis=1)))
    away = shaken.positions_m[i] - clean.positions_m[i]
    assert np.linalg.norm(away) > 0.5
    write_map(workplace, (shaken.positions_m[i] + 0.2 * away, [0.3, 0.3, 0.3]))
    found = findings(workplace)
    assert found["aug_001"]["collision"] == "error"
    assert "collision" not in found["ORI"]
    by_variant = {f.variant: f for f in read_inspection(workplace / "out/inspect.json").flights[:2]}
    post = obstacle_index(read_boxes(workplace / "map.json"))
    along = np.linspace(0, 1, 501)[:, None, None]
    way_m = (clean.positions_m[:-1] * (1 - along) + clean.positions_m[1:] * along).reshape(-1, 3)
    for flight, places_m in ((clean, way_m), (shaken, shaken.positions_m)):
        least = signed_distances(post, places_m)[0].min()
        assert by_variant[flight.variant].metrics["clearance_min_m"] == pytest.approx(least, abs=1e-4)
    assert f">{by_variant['aug_001'].metrics['clearance_min_m']:.2f}<" in (workplace / "out/report.html").read_text()


@pytest.mark.parametrize(
    ("beside_m", "codes"), [(2.6, set()), (2.4, {"clearance"}), (-0.1, {"collision", "clearance"})]
)
def test_clearance_has_a_floor(workplace, beside_m, codes):
    flight = read_track(first_flight(workplace))
    top = flight.positions_m[:, 2].max()
    write_map(workplace, ([*flight.positions_m[:, :2].mean(axis=0), top + beside_m + 50.0], [500.0, 500.0, 50.0]))
    found = findings(workplace)["ORI"].keys() & {"clearance", "collision"}
    assert found <= codes
    assert bool(found) == bool(codes)


def test_what_hides_or_holds_the_person_is_found(workplace):
    flight = read_track(first_flight(workplace))
    write_map(workplace, (flight.targets_m[4], [0.1, 0.1, 0.1]))
    assert findings(workplace)["ORI"]["collision"] == "error"
    middle = 0.5 * (flight.positions_m + flight.targets_m).mean(axis=0)
    middle[2] = 0.5 * (flight.positions_m[:, 2].min() + flight.targets_m[:, 2].max())
    write_map(workplace, (middle, [300.0, 300.0, 0.05]))
    assert findings(workplace)["ORI"]["five_ray_visibility"] == "error"
    assert "five_ray_visibility" not in findings(workplace, CFG.model_copy(update={"five_ray_mean_min": 0.0}))["ORI"]


def edit_image(path: Path, change) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    cv2.imwrite(str(path), change(image).astype(np.uint8))


def instances(change):
    return lambda f: edit_image(f / FRAME / "instance.png", change)


def depths(change):
    return lambda f: np.save(f / FRAME / "depth.npy", change(np.load(f / FRAME / "depth.npy")).astype("f4"))


def flip_byte(path: Path, position: int) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 0x10
    path.write_bytes(data)


def told(change):
    return lambda f: change_json(f / "trajectory.json", change)


def at_point(key, name, value):
    return told(lambda trajectory: trajectory["points"][3][key].update({name: value}))


def record_masks(folder: Path, wrong: dict[int, list[float] | None]) -> None:
    boxes = [mask_box(read_instance(folder / frame_name(i))[0] == 12) for i in range(NUM_POINTS)]
    named = {i: None if np.isnan(box).any() else box.tolist() for i, box in enumerate(boxes)} | wrong
    told(lambda t: [t["points"][i]["target"].update(mask_bbox_2d=box) for i, box in named.items()])(folder)


FRAME = frame_name(3)
DEFECTS = {
    "missing_file": lambda f: (f / FRAME / "rgb.png").unlink(),
    "wrong_format": lambda f: cv2.imwrite(str(f / FRAME / "rgb.png"), np.full((20, 30, 3), 9, np.uint8)),
    "broken_image of cut depth": lambda f: (f / FRAME / "depth.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr'"),
    "broken_image": lambda f: flip_byte(f / FRAME / "rgb.png", 200),
    "broken_annotation": lambda f: (f / FRAME / "meta.json").write_text("{"),
    "checksum": lambda f: flip_byte(f / FRAME / "meta.json", 30),
    "depth_range": depths(lambda d: np.where(d > 14, np.nan, d)),
    "depth_range above": depths(lambda d: d + 1000),
    "depth_disagrees": depths(lambda d: (d + 5) % 1000),
    "mask_disagrees small": lambda f: record_masks(f, {3: [1.0, 1.0, 3.0, 3.0]}),
    "mask_disagrees large": lambda f: record_masks(f, {3: [0.0, 0.0, 192.0, 108.0]}),
    "mask_disagrees null": lambda f: record_masks(f, {3: None}),
    "mask_disagrees": instances(lambda image: np.where(image[..., 2:] == KINDS["Pedestrians"], 0, image)),
    "blank_frame": lambda f: edit_image(f / FRAME / "rgb.png", lambda image: image * 0 + 90),
    "frozen_frame": lambda f: shutil.copy(f / frame_name(2) / "rgb.png", f / FRAME / "rgb.png"),
    "pose_differs": at_point("drone_pose", "yaw", 12.0),
    "projection_differs": at_point("target", "image_uv", [1.0, 2.0]),
    "target_missing": at_point("target", "world_location", None),
    "layout": told(lambda t: t.update(schema_version="6.0.0")),
    "pose_differs in place": told(
        lambda t: t["points"][3]["drone_pose"].update(z=t["points"][3]["drone_pose"]["z"] + 0.1)
    ),
    "pose_differs of the person": told(lambda t: t["points"][3]["target"]["world_location"].update(x=9.0)),
    "projection_differs of the box": at_point("target", "bbox_2d", {"xmin": 1, "ymin": 2, "xmax": 3, "ymax": 4}),
    "projection_differs in depth": at_point("target", "depth", 1.0),
    "target_missing in the picture": at_point("target", "image_uv", None),
    "illegible": told(lambda t: [p["target"].update(legible=False) for p in t["points"]]),
    "teleport": at_point("drone_pose", "x", 99.0),
    "broken_annotation of another frame": lambda f: change_json(f / FRAME / "meta.json", lambda m: m.update(index=4)),
    "broken_image of instances": instances(lambda image: image[:54, :96]),
    "broken_image in grey": lambda f: cv2.imwrite(str(f / FRAME / "rgb.png"), np.eye(108, 192, dtype=np.uint8)),
    "checksum of the list": lambda f: (f / "checksums.sha256").write_text("frame_00003"),
    "depth_range everywhere": depths(lambda d: d * 0 + 7),
}


def largest_surface(folder: Path) -> np.ndarray:
    """Pixels of the surface that fills most of frame 3, (h, w) bool."""
    kinds, ids = read_instance(folder / FRAME)
    numbers, counts = np.unique(ids[(kinds != KINDS["Pedestrians"]) & (kinds != KINDS["NONE"])], return_counts=True)
    return ids == numbers[counts.argmax()]


def paint(folder: Path, color: tuple[int, int, int], *, grain: bool) -> None:
    surface = largest_surface(folder)

    def change(image: np.ndarray) -> np.ndarray:
        image[surface] = color
        noise = np.random.default_rng(0).integers(-6, 7, image.shape)
        grainy = np.clip(image.astype(int) + noise, 0, 255)
        return grainy if grain else np.where(surface[..., None], image, grainy)

    edit_image(folder / FRAME / "rgb.png", change)


def let_fight(folder: Path) -> None:
    surface = largest_surface(folder)
    surface[:, ::2] = False
    instances(lambda image: np.where(surface[..., None], (1, 77, KINDS["Walls"]), image))(folder)


def gone(depth: np.ndarray) -> np.ndarray:
    """Depth with a part that lies farther off: what stood there is gone."""
    part = depth[: len(depth) // 2, : depth.shape[1] // 2]
    part[part < 900] += 60.0
    return depth


# What a person has to look at; where None stands, the finding is of the whole flight.
TO_REVIEW = {
    "missing_texture of one colour": lambda f: paint(f, (120, 125, 130), grain=False),
    "missing_texture magenta": lambda f: paint(f, (240, 20, 240), grain=True),
    "z_fighting": let_fight,
    "temporal_jump gone": depths(gone),
    "temporal_jump near": depths(lambda d: np.where(d < 900, 0.8 * d, d)),
    "invalid_depth": depths(lambda d: np.where(np.arange(len(d))[:, None] < 5, 0, d)),
    "shorter_than_planned": told(lambda t: (t["points"].pop(), t["points"][-1]["nav_waypoint"].update(t1_world=None))),
    "never_visible": told(lambda t: [p["target"].update(visible=False) for p in t["points"]]),
    "track_quality": lambda f: [edit_image(f / frame_name(i) / "instance.png", slimmer) for i in range(NUM_POINTS)],
    "stray_frame": lambda f: shutil.copytree(f / frame_name(0), f / frame_name(99)),
    "no_trace": told(lambda t: t["source"].update(scenario_id="another")),
}


def slimmer(image: np.ndarray) -> np.ndarray:
    is_person = image[..., 2] == KINDS["Pedestrians"]
    rows = np.flatnonzero(is_person.any(axis=1))
    if len(rows):
        is_person[rows[0]] = False
        image[is_person] = (0, 1, KINDS["Roads"])
    return image


@pytest.mark.parametrize("form", ["npy", "png"])
def test_far_is_far(workplace, form):
    folder, path = first_flight(workplace), first_flight(workplace) / FRAME / "depth.npy"
    depth, top_row = np.load(path), np.arange(108)[:, None] == 0
    name, data = depth_file(np.where(top_row, np.float32(1000.2), depth), form)
    path.unlink()
    (folder / FRAME / name).write_bytes(data)
    sky = (0, 0, KINDS["Sky"])
    instances(lambda image: np.where(top_row[..., None], sky, image))(folder)
    assert codes_of(inspect(workplace, NO_SUMS), folder) == {}
    assert read_depth(folder / FRAME).max() == 1000.0


def plant(specimen: Path, root: Path, defects: dict) -> None:
    pair = first_flight(specimen).parent
    plan, plans = plan_of(pair / "ORI"), []
    for number, defect in enumerate(["", *defects]):
        trajectory = shutil.copytree(pair, root / f"tree/Town01/trajectory_{1_776_000_000 + number}")
        for folder in trajectory.iterdir():
            told(lambda t, name=str(number): t["source"].update(scenario_id=name))(folder)
        plans.append(replace(plan, path_id=str(number)))
        list_files(trajectory)
        if defect:
            defects[defect](trajectory / "ORI")
    write_traces(root / "drone_trace.json", plans, {})
    write_map(root)


@pytest.mark.parametrize(
    ("defects", "cfg", "severity"),
    [(DEFECTS, CFG, "error"), (TO_REVIEW, NO_SUMS, "warning")],
    ids=["DEFECTS", "REVIEW"],
)
def test_a_planted_defect_is_found_in_that_flight_alone(specimen, tmp_path, subtests, defects, cfg, severity):
    plant(specimen, tmp_path, defects)
    found = inspect(tmp_path, cfg)
    flights = sorted(found.flights, key=lambda f: f.folder)
    clean, *pairs = zip(flights[::2], flights[1::2], strict=True)
    assert [flight.issues for flight in clean] == [[], []]
    assert severity == "warning" or found.funnel.trajectories.rejected == len(defects)
    for defect, (broken, twin) in zip(defects, pairs, strict=True):
        with subtests.test(defect):
            code = defect.split()[0]
            issue = next(issue for issue in broken.issues if issue.code == code)
            assert issue.severity == severity
            assert str(tmp_path) not in issue.where  # a report can be handed on
            if severity == "error":
                assert FRAME in issue.where or "points[3]" in issue.where or code in ("layout", "checksum", "illegible")
                assert (broken.result, twin.result) == ("rejected", "accepted")
            assert code not in {issue.code for issue in twin.issues}


@pytest.mark.parametrize("shape", [(1, 1), (5, 1), (1, 5)])
def test_a_picture_of_one_row_or_column_is_measured(shape):
    kinds = np.full(shape, KINDS["Buildings"], np.uint8)
    instance = np.dstack([kinds, np.ones_like(kinds), np.zeros_like(kinds)])
    picture = Picture(np.full((*shape, 3), 90, np.uint8), np.ones(shape, np.float32), instance)
    figures = measure_pixels(picture, np.zeros(NUM_IDS, bool), 0.9)
    assert (figures.flat, figures.fighting, figures.magenta, figures.person_box) == (0.0, 0.0, 0.0, None)


@pytest.mark.parametrize(("beside", "shift_m", "codes"), [
    ("drone", (0.0, 0.0, -1.0), {"clearance"}),
    ("drone", (0.0, 0.0, -8.0), set()),
    ("target", (0.4, 0.0, 0.0), {"collision"}),
    ("target", (0.7, 0.0, 0.0), set()),
    ("kind", (50.0, 0.0, 0.0), {"broken_annotation"}),
], ids=["at_the_drone", "below_the_drone", "in_the_person", "beside_the_person", "a_tree"])  # fmt: skip
def test_others_keep_clear_of_drone_and_person(workplace, beside, shift_m, codes):
    flight, report, metrics = read_track(first_flight(workplace)), Report(), {}
    place_m = (flight.positions_m if beside == "drone" else flight.targets_m)[3] + np.array(shift_m)
    kind = KINDS["Vegetation" if beside == "kind" else "Pedestrians"]
    seen = {"world_location": np.asarray(place_m, float), "yaw": 0.0, "half_extents_m": (0.3, 0.3, 0.9)}
    other = BystanderMeta(instance_id=7, semantic_id=kind, num_pixels=0, **seen)
    told = BystandersMeta(target_hidden_by_others=0.25, target_hidden_by_map=0.0, others=[other])
    check_bystanders(flight, {3: told, 4: told.model_copy(update={"others": []})}, 2.5, report, metrics)
    assert {issue.code for issue in report.issues} == codes
    told = [metrics[name] for name in ("num_others", "occluded_by_others_share", "hidden_by_others_max")]
    assert told == [1, 1.0, 0.25]


def test_an_unreadable_flight_is_a_counted_failure_while_others_go_on(workplace):
    broken, twin = first_flight(workplace), first_flight(workplace, "aug_001")
    at_point("drone_pose", "x", "oops")(broken)
    found = inspect(workplace)
    assert codes_of(found, twin) == {}
    flight = next(f for f in found.flights if f.folder.endswith(f"{broken.parent.name}/ORI"))
    assert (flight.result, flight.reason) == ("rejected", "unreadable")
    assert "points[3].drone_pose.x" in flight.issues[0].got
    manifest = read_json(workplace / "out" / "manifest.json")
    assert manifest["counts"] == {"input": 4, "kept": 3, "dropped": {}, "failed": {"input": 1}}
    assert "trajectory.json" in (workplace / "out" / "failures.jsonl").read_text()
    assert found.funnel.trajectories.rejected == 1  # counted with its twin's trajectory


def test_the_funnel_counts_prefiltered_and_unrendered_plans(workplace):
    plans = [plan_of(f) for f in find_tracks(workplace / "tree") if f.name == "ORI"]
    reasons = {"low": "five_ray_visibility", "rough": "smoothness", "lost": None}
    extra = [replace(plans[0], path_id=name, drop_reason=reason) for name, reason in reasons.items()]
    write_traces(workplace / "drone_trace.json", plans + extra, {})
    funnel = inspect(workplace).funnel.trajectories
    assert (funnel.planned, funnel.rendered, funnel.not_rendered) == (5, 2, 1)
    assert funnel.dropped == {"five_ray_visibility": 1, "smoothness": 1}
