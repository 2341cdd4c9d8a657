"""Lies about a release, each told with hashes, counts and card made right again. A lie changes the rows in place."""

import copy
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from release_tampering import depth_of, set_depth

from cosfly.formats.frames import rgb_bytes
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.geometry.axes import box_corners, mask_box, project, world_from_camera
from cosfly.runtime.png import colours_of

Row = dict[str, Any]
Rows = list[Row]
Lie = Callable[[Rows], None]
Choose = Callable[[Rows], Rows]
XYZ = ("x_m", "y_m", "z_m")
BOX = ("xmin_px", "ymin_px", "xmax_px", "ymax_px")
SKY_M = 999.0


def flight_of(rows: Rows, one: Row) -> Rows:
    return [row for row in rows if (row["trajectory"], row["variant"]) == (one["trajectory"], one["variant"])]


def clean(rows: Rows) -> Rows:
    return flight_of(rows, next(row for row in rows if row["track"] == "clean"))


def perturbed(rows: Rows) -> Rows:
    return flight_of(rows, next(row for row in rows if row["track"] == "perturbed"))


def captioned(rows: Rows) -> Rows:
    return [row for row in rows if row["has_caption"]]


def seen(rows: Rows) -> Rows:
    return [row for row in clean(rows) if row["target_visible"]]


def at(choose: Choose, k: int) -> Choose:
    return lambda rows: [choose(rows)[k]]


def half(choose: Choose) -> Choose:
    return lambda rows: [choose(rows)[len(choose(rows)) // 2]]


def first(choose: Choose, holds: Callable[[Row], Any]) -> Choose:
    return lambda rows: [next(row for row in choose(rows) if holds(row))]


def everything(rows: Rows) -> Rows:
    return rows


def put(choose: Choose, **values: Any) -> Lie:
    return change(choose, lambda row: row.update(copy.deepcopy(values)))


def change(choose: Choose, what: Callable[[Row], Any]) -> Lie:
    def lie(rows: Rows) -> None:
        for row in choose(rows):
            what(row)

    return lie


def swapped(choose: Choose, a: int, b: int, name: str) -> Lie:
    def lie(rows: Rows) -> None:
        one, other = choose(rows)[a], choose(rows)[b]
        one[name], other[name] = other[name], one[name]

    return lie


def add(name: str, number: float, *members: str) -> Callable[[Row], None]:
    def added(row: Row) -> None:
        if members:
            row[name] = row[name] | {member: row[name][member] + number for member in members}
        else:
            row[name] += number

    return added


def projected(row: Row) -> None:
    """Make pixel, depth and boxes of the target those of its pose again."""
    pose, k, size = row["pose"], row["intrinsics"], [row["width_px"], row["height_px"]]
    angles = np.array([pose["pitch_deg"], pose["yaw_deg"], pose["roll_deg"]])
    camera = world_from_camera(np.array([pose[axis] for axis in XYZ]), angles)
    matrix = np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1.0]])
    target = np.array([row["target"][axis] for axis in XYZ])
    uv, z = project(target[None], camera, matrix)
    corners, _ = project(box_corners(target, np.array(PERSON_HALF_EXTENTS_M)), camera, matrix)
    if np.isnan(corners).any():
        return
    row["target_uv"], row["target_depth_m"] = {"u_px": float(uv[0, 0]), "v_px": float(uv[0, 1])}, float(z[0])
    if row["target_bbox"] is not None:
        ends = np.clip([corners.min(axis=0), corners.max(axis=0)], 0, size)
        row["target_bbox"] = dict(zip(BOX, map(float, ends.ravel()), strict=True))


def turned(choose: Choose, what: Callable[[Row], Any]) -> Lie:
    def both(row: Row) -> None:
        what(row)
        projected(row)

    return change(choose, both)


def with_depth(of: Callable[[np.ndarray, Row], np.ndarray]) -> Callable[[Row], None]:
    """Change what is seen of a depth; the sky stays."""

    def changed(row: Row) -> None:
        depth = depth_of(row)
        new = np.where(depth < SKY_M, np.minimum(of(depth, row), SKY_M - 1), depth)
        set_depth(row, new.astype(np.float32))

    return changed


def with_ids(of: Callable[[np.ndarray, np.ndarray], Any]) -> Callable[[Row], None]:
    """Change a mask in place: (h, w, 3) and its ids (h, w)."""

    def changed(row: Row) -> None:
        pixels = colours_of(row["instance"]["bytes"], "x").copy()
        of(pixels, pixels[..., 1].astype(int) | pixels[..., 2].astype(int) << 8)
        row["instance"]["bytes"] = rgb_bytes(pixels)

    return changed


def another_camera(row: Row) -> None:
    row["intrinsics"]["fx"] = row["intrinsics"]["fy"] = row["intrinsics"]["fx"] * 1.2
    row["fov_deg"] = round(math.degrees(2 * math.atan(row["width_px"] / (2 * row["intrinsics"]["fx"]))), 6)


def mirrored_world(row: Row) -> None:
    for place in filter(None, (row["pose"], row["target"])):
        place["x_m"], place["y_m"] = place["y_m"], place["x_m"]
    row["pose"]["yaw_deg"] = 90.0 - row["pose"]["yaw_deg"]
    if row["target_heading_deg"] is not None:
        row["target_heading_deg"] = 90.0 - row["target_heading_deg"]


def nobody_followed(row: Row) -> None:
    nulls = ("target", "target_uv", "target_bbox", "target_mask_bbox", "target_depth_m", "target_heading_deg")
    row.update(dict.fromkeys(nulls), target_in_view=False, target_visible=False, visibility=0.0)


def with_poses(own: Rows, others: Rows) -> None:
    poses = [dict(other["pose"]) for other in others]
    for row, pose in zip(own, poses, strict=True):
        row["pose"] = pose
        projected(row)


DECISIONS = ("decision", "caption_en_flight_decision", "caption_zh_flight_decision")


def hard_conflict_called_soft(row: Row) -> None:
    wrong = "move_backward" if row["label"] != "move_backward" else "ascend"
    row.update(dict.fromkeys(DECISIONS, wrong), verdict="SOFT_CONFLICT")


def not_a_number(row: Row) -> None:
    depth = depth_of(row)
    depth[3, 3] = np.nan
    set_depth(row, depth)


def ids_exchanged(pixels: np.ndarray, ids: np.ndarray) -> None:
    known, new = [k for k in np.unique(ids) if k not in (0, 65534, 65535)], ids.copy()
    for own, other in zip(known, [*known[1:], known[0]], strict=True):
        new[ids == own] = other
    pixels[..., 1], pixels[..., 2] = new & 255, new >> 8


def second_person(row: Row) -> None:
    pixels = colours_of(row["instance"]["bytes"], "x").copy()
    pixels[-4:, -4:] = (12, 255, 255)
    row["instance"]["bytes"] = rgb_bytes(pixels)
    row["target_mask_bbox"] = dict(zip(BOX, mask_box((pixels[..., 1:] == 255).all(axis=-1)).tolist(), strict=True))


not_hovering = first(captioned, lambda row: row["decision"] != "hover")
caption, middle, middle_seen = at(captioned, 0), half(clean), half(seen)
ids_of_things_exchanged = change(middle, with_ids(ids_exchanged))
box_moved = change(at(seen, 1), add("target_bbox", 4.0, *BOX))
LIES_OF_ROWS: dict[str, Lie] = {
    "sample_id_of_another_frame": change(at(clean, 3), lambda r: r.update(sample_id=r["sample_id"][:-5] + "00999")),
    "label_outside_the_set": put(caption, label="fly_away"),
    "consistent_with_another_decision": change(
        first(captioned, lambda r: r["label"] and r["decision"] == r["label"]),
        lambda r: r.update(label="hover" if r["label"] != "hover" else "ascend"),
    ),
    "visibility_above_one": put(at(clean, 0), visibility=1.7),
    "called_legible": put(at(clean, 0), target_legible=True, target_contrast=1.0),
    "track_against_variant": put(clean, track="perturbed"),
    "path_that_escapes": put(clean, run=".."),
    "time_backwards": swapped(clean, 2, 3, "time_s"),
    "all_targets_null": change(everything, nobody_followed),
    "infinite_angle": change(at(clean, 1), lambda r: r["drone_offset"].update(roll_deg=math.inf)),
    "field_of_view_against_focal_length": put(clean, fov_deg=75.0),
    "target_pixel_moved": change(at(seen, 1), add("target_uv", 3.0, "u_px")),
    "box_moved": box_moved,
    "target_depth_against_depth": change(at(seen, 1), add("target_depth_m", 5.0)),
    "poses_of_two_frames_exchanged": lambda rows: with_poses(clean(rows)[4:10:5], clean(rows)[9:3:-5]),
    "pose_jumps": turned(at(clean, 6), add("pose", 20.0, "x_m")),
    "window_into_the_future": change(caption, lambda r: r.update(caption_window=[i + 1 for i in r["caption_window"]])),
    "decision_differs_between_languages": put(not_hovering, caption_zh_flight_decision="hover"),
    "decision_and_label_changed_together": put(
        not_hovering, **dict.fromkeys((*DECISIONS, "label"), "hover"), verdict="CONSISTENT"
    ),
    "hard_conflict_called_soft": change(at(captioned, 1), hard_conflict_called_soft),
    "split_that_leaks": change(clean, lambda r: r.update(split="test" if r["split"] != "test" else "train")),
    "pair_lost": put(clean, pair=None),
}  # fmt: skip
LIES_OF_PIXELS: dict[str, Lie] = {
    "another_camera_all_along": turned(clean, another_camera),
    "box_against_mask": change(at(seen, 1), add("target_mask_bbox", 2.0, "xmin_px", "xmax_px")),
    "world_turned": turned(clean, mirrored_world),
    "depth_of_neighbours_exchanged": swapped(perturbed, 4, 5, "depth"),
    "depth_doubled": change(at(seen, 2), with_depth(lambda depth, _: depth * 2)),
    "depth_not_a_number": change(at(clean, 3), not_a_number),
    "depth_in_centimetres_called_lossless": change(clean, with_depth(lambda depth, _: np.round(depth, 2))),
    "depth_set_off": change(everything, with_depth(lambda depth, _: depth + 0.3)),
    "empty_instances": change(at(seen, 2), with_ids(lambda pixels, _: pixels.fill(0))),
    "second_person_far_away": change(middle_seen, second_person),
    "ids_of_things_exchanged": ids_of_things_exchanged,
    "jpeg_under_a_png_name": change(
        at(clean, 2),
        lambda r: r["image"].update(bytes=cv2.imencode(".jpg", colours_of(r["image"]["bytes"], "x"))[1].tobytes()),
    ),
}  # fmt: skip
# name -> the lie, and whether only pixels tell it
LIES = {name: (lie, False) for name, lie in LIES_OF_ROWS.items()} | {
    name: (lie, True) for name, lie in LIES_OF_PIXELS.items()
}
