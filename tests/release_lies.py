"""Lies about a release, each told with hashes, counts and card made right again. A lie changes the rows in place; `True`: pixels tell it."""

from __future__ import annotations

import copy
import math
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from release_tampering import depth_of, pixels_of, png, set_depth

from cosfly.products.kinds import KINDS

Row = dict[str, Any]
Lie = Callable[[list[Row]], None]


def clean(rows: list[Row]) -> list[Row]:
    """The rows of the first clean flight."""
    first = next(row for row in rows if row["track"] == "clean")
    return flight_of(rows, first)


def flight_of(rows: list[Row], one: Row) -> list[Row]:
    return [row for row in rows if (row["trajectory"], row["variant"]) == (one["trajectory"], one["variant"])]


def perturbed(rows: list[Row]) -> list[Row]:
    first = next(row for row in rows if row["track"] == "perturbed")
    return flight_of(rows, first)


def shifted(rows: list[Row]) -> Row:
    return next(row for row in perturbed(rows) if row["perturbation"]["position"] == "applied")


def captioned(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["has_caption"]]


def seen(rows: list[Row]) -> list[Row]:
    return [row for row in clean(rows) if row["target_visible"]]


def other_flight(rows: list[Row]) -> list[Row]:
    """A clean flight of another trajectory; where there is none, the perturbed one."""
    own = clean(rows)[0]
    others = (row for row in rows if row["track"] == "clean" and row["trajectory"] != own["trajectory"])
    one = next(others, None)
    return perturbed(rows) if one is None else flight_of(rows, one)


def swap(one: Row, other: Row, *names: str) -> None:
    for name in names:
        one[name], other[name] = other[name], one[name]


def projected(row: Row) -> None:
    """Make pixel, depth and boxes of the target those of its pose again."""
    from cosfly.geometry import box_corners, project, world_from_camera
    from cosfly.products.walks import PERSON_HALF_EXTENTS_M

    pose, k = row["pose"], row["intrinsics"]
    camera = world_from_camera(
        np.array([pose["x_m"], pose["y_m"], pose["z_m"]]),
        np.array([pose["pitch_deg"], pose["yaw_deg"], pose["roll_deg"]]),
    )
    matrix = np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1.0]])
    target = np.array([row["target"][axis] for axis in ("x_m", "y_m", "z_m")])
    uv, z = project(target[None], camera, matrix)
    corners, _ = project(box_corners(target, np.array(PERSON_HALF_EXTENTS_M)), camera, matrix)
    if np.isnan(corners).any():
        return
    low = np.clip(corners.min(axis=0), 0, [row["width_px"], row["height_px"]])
    high = np.clip(corners.max(axis=0), 0, [row["width_px"], row["height_px"]])
    row["target_uv"] = {"u_px": float(uv[0, 0]), "v_px": float(uv[0, 1])}
    row["target_depth_m"] = float(z[0])
    if row["target_bbox"] is not None:
        row["target_bbox"] = dict(
            zip(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), map(float, (*low, *high)), strict=True)
        )


# --- identity ---------------------------------------------------------------------------------------------------------


def sample_id_of_another_frame(rows):
    clean(rows)[3]["sample_id"] = clean(rows)[3]["sample_id"][:-5] + "00999"


def label_outside_the_set(rows):
    captioned(rows)[0]["label"] = "fly_away"


def verdict_outside_the_set(rows):
    captioned(rows)[0]["verdict"] = "FINE"


def consistent_with_another_decision(rows):
    row = next(r for r in captioned(rows) if r["label"] and r["decision"] == r["label"])
    row["label"] = "hover" if row["label"] != "hover" else "ascend"


def visibility_above_one(rows):
    clean(rows)[0]["visibility"] = 1.7


def visible_but_not_in_view(rows):
    seen(rows)[0]["target_in_view"] = False


def perturbed_without_offsets(rows):
    row = next(r for r in perturbed(rows) if not r["is_perturbed"])
    row["is_perturbed"] = True


def offsets_without_flag(rows):
    shifted(rows)["is_perturbed"] = False


def track_against_variant(rows):
    for row in clean(rows):
        row["track"] = "perturbed"


def path_that_escapes(rows):
    for row in clean(rows):
        row["run"] = ".."


def time_backwards(rows):
    own = clean(rows)
    swap(own[2], own[3], "time_s")


def a_second_lost(rows):
    for row in clean(rows)[5:]:
        row["time_s"] += 1.0


def time_stretched(rows):
    for row in clean(rows):
        row["time_s"] *= 1.5


def all_targets_null(rows):
    for row in rows:
        for name in ("target", "target_uv", "target_bbox", "target_mask_bbox", "target_depth_m", "target_heading_deg"):
            row[name] = None
        row["target_in_view"] = row["target_visible"] = False
        row["visibility"] = 0.0


def infinite_angle(rows):
    clean(rows)[1]["drone_offset"]["roll_deg"] = math.inf


def field_of_view_against_focal_length(rows):
    for row in clean(rows):
        row["fov_deg"] = 75.0


def focal_lengths_exchanged(rows):
    for row in clean(rows):
        row["intrinsics"]["fy"] *= 1.1
        projected(row)


def principal_point_moved(rows):
    for row in clean(rows):
        row["intrinsics"]["cx"] += 12.0
        projected(row)


def another_camera_all_along(rows):
    """A field of view that fits its focal length, and everything projected anew."""
    for row in clean(rows):
        row["intrinsics"]["fx"] = row["intrinsics"]["fy"] = row["intrinsics"]["fx"] * 1.2
        row["fov_deg"] = round(math.degrees(2 * math.atan(row["width_px"] / (2 * row["intrinsics"]["fx"]))), 6)
        projected(row)
        row["target_mask_bbox"] = row["target_mask_bbox"] and dict(row["target_mask_bbox"])


# --- geometry and motion ----------------------------------------------------------------------------------------------


def target_pixel_moved(rows):
    seen(rows)[1]["target_uv"]["u_px"] += 3.0


def box_against_mask(rows):
    box = seen(rows)[1]["target_mask_bbox"]
    box["xmin_px"] += 2.0
    box["xmax_px"] += 2.0


def box_moved(rows):
    box = seen(rows)[1]["target_bbox"]
    for name in box:
        box[name] += 4.0


def target_depth_against_depth(rows):
    seen(rows)[1]["target_depth_m"] += 5.0


def target_far_behind_on_its_line(rows):
    """The target moved along its line of sight: pixel right, depth made right, boxes made right."""
    for row in seen(rows):
        for axis in ("x_m", "y_m", "z_m"):
            row["target"][axis] = row["pose"][axis] + 1.4 * (row["target"][axis] - row["pose"][axis])
        projected(row)


def pose_of_the_next_frame(rows):
    own = clean(rows)
    own[4]["pose"] = dict(own[5]["pose"])
    projected(own[4])


def poses_of_two_frames_exchanged(rows):
    own = clean(rows)
    swap(own[4], own[9], "pose")
    projected(own[4])
    projected(own[9])


def poses_of_two_flights_exchanged(rows):
    for one, other in zip(clean(rows), other_flight(rows), strict=False):
        swap(one, other, "pose", "target", "target_uv", "target_bbox", "target_depth_m", "target_heading_deg")
        swap(one, other, "intrinsics", "fov_deg")


def pose_frozen(rows):
    own = clean(rows)
    for row in own[5:12]:
        row["pose"] = dict(own[5]["pose"])
        projected(row)


def pose_jumps(rows):
    row = clean(rows)[6]
    row["pose"]["x_m"] += 20.0
    projected(row)


def world_turned(rows):
    """North and east exchanged for one flight, everything projected anew: a mirror image."""
    for row in clean(rows):
        for place in (row["pose"], row["target"]):
            if place:
                place["x_m"], place["y_m"] = place["y_m"], place["x_m"]
        row["pose"]["yaw_deg"] = 90.0 - row["pose"]["yaw_deg"]
        if row["target_heading_deg"] is not None:
            row["target_heading_deg"] = 90.0 - row["target_heading_deg"]
        if row["target"]:
            projected(row)


def lower_than_it_was(rows):
    """A flight three metres lower, target too: nothing of a row tells."""
    for row in clean(rows):
        row["pose"]["z_m"] -= 3.0


def heading_backwards(rows):
    for row in clean(rows):
        if row["target_heading_deg"] is not None:
            row["target_heading_deg"] = (row["target_heading_deg"] + 180.0 + 180.0) % 360.0 - 180.0


def offsets_with_the_other_sign(rows):
    for row in perturbed(rows):
        row["drone_offset"] = {name: -value + 0.0 for name, value in row["drone_offset"].items()}


def target_offset_lost(rows):
    row = shifted(rows)
    row["target_offset"] = {"x_m": 0.0, "y_m": 0.0, "z_m": 0.0}


def unperturbed_called_applied(rows):
    row = next(r for r in perturbed(rows) if r["perturbation"]["rotation"] == "none")
    row["perturbation"]["rotation"] = "applied"


def undrawn_event_called_fallback(rows):
    row = next(r for r in perturbed(rows) if r["perturbation"]["rotation"] == "none")
    row["perturbation"]["rotation"] = "fallback: target out of view"


def perturbation_taken_off(rows):
    """A frame is that of the clean flight, pictures too: flag, words, offsets, pose and pixels agree."""
    row = shifted(rows)
    twin = next(r for r in clean(rows) if r["frame_index"] == row["frame_index"])
    kept = ("sample_id", "variant", "track", "pair")
    row.update({name: copy.deepcopy(value) for name, value in twin.items() if name not in (*kept, *CAPTION)})
    for file in ("image", "instance"):
        row[file]["path"] = row[file]["path"].replace(twin["sample_id"], row["sample_id"])
    row["perturbation"] = {"position": "none", "rotation": "none"}


def pace_called_otherwise(rows):
    """In both flights of a walk."""
    own = clean(rows)[0]["trajectory"]
    for row in (row for row in rows if row["trajectory"] == own):
        row["pace"] = "hurry"


def clean_flight_from_another_time(rows):
    for row in perturbed(rows):
        row["time_s"] += 0.5


# --- captions ---------------------------------------------------------------------------------------------------------


def window_into_the_future(rows):
    row = captioned(rows)[0]
    row["caption_window"] = [index + 1 for index in row["caption_window"]]


def window_with_a_gap(rows):
    row = captioned(rows)[0]
    row["caption_window"][0] -= 1


def decision_differs_between_languages(rows):
    captioned(rows)[0]["caption_zh_flight_decision"] = "hover"


def number_differs_between_languages(rows):
    for row in captioned(rows):
        for name in ("caption_zh_reasoning_trace", "caption_zh_critical_components"):
            text = re.sub(r"(\d+)\.(\d)", lambda m: f"{int(m[1]) + 3}.{m[2]}", row[name], count=1)
            if text != row[name]:
                row[name] = text
                return
    raise AssertionError("no number to change")


def side_differs_between_languages(rows):
    for row in captioned(rows):
        for name in ("caption_zh_reasoning_trace", "caption_zh_critical_components"):
            if "左" in row[name] or "右" in row[name]:
                row[name] = row[name].translate(str.maketrans("左右", "右左"))
                return
    raise AssertionError("no side to change")


def number_wrong_in_both_languages(rows):
    for row in captioned(rows):
        found = re.search(r"(\d+\.\d) m\b", row["caption_en_critical_components"])
        if found and found[1] in row["caption_zh_critical_components"]:
            wrong = f"{float(found[1]) + 7.3:.1f}"
            for language in ("en", "zh"):
                name = f"caption_{language}_critical_components"
                row[name] = row[name].replace(found[1], wrong)
            return
    raise AssertionError("no number to change")


CAPTION = [
    "decision", "label", "label_from", "verdict", "repair_strategy", "teacher_kind", "teacher_model", "writing", "proved_en", "proved_zh",
    *(f"{state}_sentences_{lang}" for state in ("proved", "contradicted", "unread") for lang in ("en", "zh")),
    "sentence_states_en", "sentence_states_zh",
    *(f"caption_{lang}_{name}" for lang in ("en", "zh") for name in ("critical_components", "reasoning_trace", "flight_decision")),
    "system_en", "system_zh", "prompt_en", "prompt_zh",
]  # fmt: skip
TEXTS = [name for name in CAPTION if name.startswith(("caption_", "sentence", "proved_", "unread", "contradicted"))]


def captions_of_two_windows_exchanged(rows):
    """Everything of two captions but the window itself, of flights that go differently."""
    own = captioned(rows)
    swap(own[0], own[-1], *CAPTION)


def texts_of_two_windows_exchanged(rows):
    """Texts alone, of two windows with the same decision."""
    own = captioned(rows)
    for one in own:
        for other in reversed(own):
            if one["trajectory"] != other["trajectory"] and one["decision"] == other["decision"]:
                swap(one, other, *TEXTS)
                return
    raise AssertionError("no such windows")


def decision_and_label_changed_together(rows):
    """The decision in the row and in both languages, label and verdict: all of it says hover."""
    row = next(r for r in captioned(rows) if r["decision"] != "hover")
    for name in ("decision", "label", "caption_en_flight_decision", "caption_zh_flight_decision"):
        row[name] = "hover"
    row["verdict"] = "CONSISTENT"


def hard_conflict_called_soft(rows):
    row = captioned(rows)[1]
    wrong = "move_backward" if row["label"] != "move_backward" else "ascend"
    for name in ("decision", "caption_en_flight_decision", "caption_zh_flight_decision"):
        row[name] = wrong
    row["verdict"] = "SOFT_CONFLICT"


def prompt_that_holds_the_future(rows):
    row = captioned(rows)[0]
    row["prompt_en"] += "\nAfter the last frame the drone turns left."
    row["prompt_zh"] += "\n最后一帧之后无人机向左转。"


def prompt_of_the_next_window(rows):
    own = captioned(rows)
    own[0]["prompt_en"], own[0]["prompt_zh"] = own[1]["prompt_en"], own[1]["prompt_zh"]


def all_sentences_called_proved(rows):
    row = captioned(rows)[0]
    row["proved_sentences_en"] = (row["proved_sentences_en"] or 0) + 1


def text_about_something_else(rows):
    row = captioned(rows)[0]
    row["caption_en_critical_components"] = "The person is 97.5 m ahead of the drone."


def chinese_in_english(rows):
    row = captioned(rows)[0]
    row["caption_zh_reasoning_trace"] = row["caption_en_reasoning_trace"]


# --- pictures ---------------------------------------------------------------------------------------------------------


def colours_of_neighbours_exchanged(rows):
    own = perturbed(rows)
    swap(own[4], own[5], "image")


def colours_of_two_flights_exchanged(rows):
    for one, other in zip(clean(rows), other_flight(rows), strict=False):
        swap(one, other, "image")


def depth_of_neighbours_exchanged(rows):
    own = perturbed(rows)
    swap(own[4], own[5], "depth")


def instances_of_neighbours_exchanged(rows):
    own = perturbed(rows)
    swap(own[4], own[5], "instance")


def instances_exchanged_with_their_boxes(rows):
    own = perturbed(rows)
    swap(own[4], own[5], "instance", "target_mask_bbox")


def depth_doubled(rows):
    row = seen(rows)[2]
    depth = depth_of(row)
    set_depth(row, np.where(depth < 1000, np.minimum(depth * 2, 999), depth).astype(np.float32))


def depth_doubled_but_at_the_person(rows):
    row = clean(rows)[4]
    depth = depth_of(row)
    far = np.where(depth < 1000, np.minimum(depth * 1.3, 999), depth).astype(np.float32)
    box = row["target_bbox"] or {"xmin_px": 0, "ymin_px": 0, "xmax_px": 1, "ymax_px": 1}
    y, x = slice(int(box["ymin_px"]), int(box["ymax_px"]) + 1), slice(int(box["xmin_px"]), int(box["xmax_px"]) + 1)
    far[y, x] = depth[y, x]
    set_depth(row, far)


def depth_not_a_number(rows):
    depth = depth_of(clean(rows)[3])
    depth[3, 3] = np.nan
    set_depth(clean(rows)[3], depth)


def distance_along_the_ray(rows):
    """Depth as the length of the ray, not along the axis, in all of a flight."""
    for row in clean(rows):
        depth, k = depth_of(row), row["intrinsics"]
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
        length = np.sqrt(((u - k["cx"]) / k["fx"]) ** 2 + ((v - k["cy"]) / k["fy"]) ** 2 + 1)
        set_depth(row, np.where(depth < 1000, np.minimum(depth * length, 999), depth).astype(np.float32))


def depth_in_centimetres(rows):
    for row in clean(rows):
        depth = depth_of(row)
        set_depth(row, np.where(depth < 1000, np.minimum(depth / 10, 999), depth).astype(np.float32))


def empty_instances(rows):
    row = seen(rows)[2]
    row["instance"]["bytes"] = png(np.zeros((row["height_px"], row["width_px"], 3), np.uint8))


def person_painted_over(rows):
    row = seen(rows)[2]
    pixels = pixels_of(row, "instance")
    pixels[(pixels[..., 1] == 255) & (pixels[..., 2] == 255)] = (1, 0, 0)
    row["instance"]["bytes"] = png(pixels)


def person_without_an_instance_of_a_person(rows):
    row = seen(rows)[2]
    pixels = pixels_of(row, "instance")
    pixels[(pixels[..., 1] == 255) & (pixels[..., 2] == 255), 0] = 3
    row["instance"]["bytes"] = png(pixels)


def jpeg_under_a_png_name(rows):
    import cv2

    row = clean(rows)[2]
    row["image"]["bytes"] = cv2.imencode(".jpg", pixels_of(row, "image"))[1].tobytes()


def smaller_picture(rows):
    import cv2

    row = clean(rows)[2]
    row["image"]["bytes"] = png(cv2.resize(pixels_of(row, "image"), (row["width_px"] // 2, row["height_px"] // 2)))


def one_picture_in_two_rows(rows):
    own = clean(rows)
    own[9]["image"] = copy.deepcopy(own[2]["image"])


def other_visibility(rows):
    row = next(r for r in seen(rows) if r["visibility"] > 0.6)
    row["visibility"] = 0.3


# --- between flights --------------------------------------------------------------------------------------------------


def split_that_leaks(rows):
    own = clean(rows)
    for row in own:
        row["split"] = "test" if row["split"] != "test" else "train"


def walk_renamed(rows):
    first = clean(rows)[0]
    for row in rows:
        if row["trajectory"] == first["trajectory"] and row["track"] == "perturbed":
            row["walk"] = "another/walk"


def walk_of_nobody(rows):
    walk = clean(rows)[0]["walk"]
    for row in rows:
        if row["walk"] == walk:
            row["walk"] = walk[:-1] + ("0" if walk[-1] != "0" else "1")


def clock_that_starts_late(rows):
    trajectory = clean(rows)[0]["trajectory"]
    for row in rows:
        if row["trajectory"] == trajectory:
            row["time_s"] += 10.0


def pair_lost(rows):
    for row in clean(rows):
        row["pair"] = None


# --- told without having seen the checks ------------------------------------------------------------------------------


def middle(rows: list[Row]) -> Row:
    own = clean(rows)
    return own[len(own) // 2]


def set_colours(row: Row, pixels: np.ndarray) -> None:
    row["image"]["bytes"] = png(pixels)


def person_of(pixels: np.ndarray) -> np.ndarray:
    return (pixels[..., 1] == 255) & (pixels[..., 2] == 255)


def box_of_person(pixels: np.ndarray) -> dict[str, float] | None:
    """Give `target_mask_bbox` of an instance image."""
    rows, columns = np.nonzero(person_of(pixels))
    if not len(rows):
        return None
    edges = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    return dict(zip(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), map(float, edges), strict=True))


def noise_in_one_depth(rows):
    depth = depth_of(middle(rows))
    noise = np.random.default_rng(0).normal(1.0, 0.003, depth.shape)
    set_depth(middle(rows), np.where(depth < 999, np.minimum(depth * noise, 998.0), depth).astype(np.float32))


def visibility_a_little_lower(rows):
    next(row for row in clean(rows) if row["visibility"] > 0.5)["visibility"] -= 0.05


def picture_that_one_sees_through(rows):
    import cv2

    pixels = pixels_of(middle(rows), "image")[..., ::-1]
    nothing = np.zeros(pixels.shape[:2], np.uint8)
    middle(rows)["image"]["bytes"] = cv2.imencode(".png", np.dstack([pixels, nothing]))[1].tobytes()


def bytes_behind_a_picture(rows):
    middle(rows)["image"]["bytes"] += b"something else " * 100


def add_chunk(row: Row, name: bytes, data: bytes) -> None:
    png_bytes, crc = row["image"]["bytes"], struct.pack(">I", zlib.crc32(name + data))
    row["image"]["bytes"] = png_bytes[:33] + struct.pack(">I", len(data)) + name + data + crc + png_bytes[33:]


def words_in_a_picture(rows):
    add_chunk(middle(rows), b"tEXt", b"Author\0somebody")


def colours_meant_darker(rows):
    add_chunk(middle(rows), b"gAMA", struct.pack(">I", 200_000))


def weather_that_nobody_drew(rows):
    for row in rows:
        row["weather"] = "HardRainNoon"


def night_that_nobody_drew(rows):
    for row in rows:
        row["time_of_day"] = "night"


def headings_lost(rows):
    for row in clean(rows):
        row["target_heading_deg"] = None


def window_with_a_frame_twice(rows):
    row = captioned(rows)[0]
    row["caption_window"] = [row["caption_window"][0], *row["caption_window"][:-1]]


def depth_of_the_twin(rows):
    row = shifted(rows)
    twin = next(r for r in clean(rows) if r["frame_index"] == row["frame_index"])
    swap(row, twin, "depth")


def frame_mirrored_with_its_boxes(rows):
    row = seen(rows)[len(seen(rows)) // 2]
    instance, width = pixels_of(row, "instance")[:, ::-1].copy(), row["width_px"]
    row["instance"]["bytes"], row["target_mask_bbox"] = png(instance), box_of_person(instance)
    set_colours(row, pixels_of(row, "image")[:, ::-1].copy())
    set_depth(row, depth_of(row)[:, ::-1].copy())
    row["target_uv"]["u_px"] = width - row["target_uv"]["u_px"]
    box = row["target_bbox"]
    box["xmin_px"], box["xmax_px"] = width - box["xmax_px"], width - box["xmin_px"]


def depth_a_hundredth_farther(rows):
    depth = depth_of(middle(rows))
    depth[depth < 999] *= np.float32(1.01)
    set_depth(middle(rows), depth)


def depth_in_decimetres_called_lossless(rows):
    for row in clean(rows):
        depth = depth_of(row)
        set_depth(row, np.where(depth < 999, np.maximum(np.round(depth, 1), 0.1), depth).astype(np.float32))


def obstacle_that_is_not_there(rows):
    depth = depth_of(middle(rows))
    depth[5:25, 5:25] = 3.0
    set_depth(middle(rows), depth)


def second_person_far_away(rows):
    row = seen(rows)[len(seen(rows)) // 2]
    pixels = pixels_of(row, "instance")
    pixels[-4:, -4:] = (12, 255, 255)
    row["instance"]["bytes"], row["target_mask_bbox"] = png(pixels), box_of_person(pixels)


def ids_of_things_exchanged(rows):
    row = middle(rows)
    pixels = pixels_of(row, "instance")
    ids = pixels[..., 1].astype(int) | pixels[..., 2].astype(int) << 8
    known = [own for own in np.unique(ids) if own not in (0, 65534, 65535)]
    new = ids.copy()
    for own, other in zip(known, [*known[1:], known[0]], strict=True):
        new[ids == own] = other
    pixels[..., 1], pixels[..., 2] = new & 255, new >> 8
    row["instance"]["bytes"] = png(pixels)


# --- of an outsider's list ---------------------------------------------------------------------------------------------


def names_of_pictures_exchanged(rows):
    swap(clean(rows)[2]["image"], clean(rows)[3]["image"], "path")


def question_that_looks_ahead(rows):
    for row in captioned(rows):
        row["system_en"] += " The frames that follow are shown too."


def depth_in_centimetres_called_lossless(rows):
    for row in clean(rows):
        depth = depth_of(row)
        set_depth(row, np.round(depth, 2).astype(np.float32))


def ids_in(row: Row) -> tuple[np.ndarray, np.ndarray]:
    """The mask of a row, and of each pixel the id."""
    pixels = pixels_of(row, "instance")
    return pixels, pixels[..., 1].astype(int) | pixels[..., 2].astype(int) << 8


def change_depth(rows: list[Row], share: float, off_m: float = 0.0) -> None:
    for row in rows:
        depth = depth_of(row)
        set_depth(row, np.where(depth < 999, np.minimum(depth * share + off_m, 998.0), depth).astype(np.float32))


def depth_scaled_by_a_fiftieth(rows):
    change_depth(rows, 1.02)


def depth_set_off(rows):
    change_depth(rows, 1.0, 0.3)


def depth_of_a_flight_scaled(rows):
    change_depth(clean(rows), 1.02)


def thing_farther_in_one_frame(rows):
    row = middle(rows)
    _, ids = ids_in(row)
    depth = depth_of(row)
    sizes = {
        own: (ids == own).sum()
        for own in np.unique(ids)
        if own not in (0, 65534, 65535) and depth[ids == own].max() < 900
    }
    thing = ids == max(sizes, key=lambda own: sizes[own] if sizes[own] < ids.size / 4 else 0)
    depth[thing] *= np.float32(1.08)
    set_depth(row, depth)


def things_of_another_kind_in_a_trajectory(rows):
    """Everything that is a building elsewhere."""
    own = clean(rows)[0]["trajectory"]
    for row in (row for row in rows if row["trajectory"] == own):
        pixels = pixels_of(row, "instance")
        pixels[pixels[..., 0] == KINDS["Buildings"], 0] = KINDS["Walls"]
        row["instance"]["bytes"] = png(pixels)


LIES: dict[str, tuple[Lie, bool]] = {
    lie.__name__: (lie, is_of_pixels)
    for is_of_pixels, lies in (
        (False, (
            sample_id_of_another_frame, label_outside_the_set, verdict_outside_the_set, consistent_with_another_decision,
            visibility_above_one, visible_but_not_in_view, perturbed_without_offsets, offsets_without_flag, track_against_variant,
            path_that_escapes, time_backwards, a_second_lost, all_targets_null, infinite_angle,
            field_of_view_against_focal_length, focal_lengths_exchanged, principal_point_moved, target_pixel_moved, box_moved,
            target_depth_against_depth, pose_jumps, heading_backwards, offsets_with_the_other_sign, target_offset_lost,
            unperturbed_called_applied, clean_flight_from_another_time, window_into_the_future, window_with_a_gap,
            decision_differs_between_languages, number_differs_between_languages, side_differs_between_languages,
            number_wrong_in_both_languages, captions_of_two_windows_exchanged, texts_of_two_windows_exchanged,
            decision_and_label_changed_together, hard_conflict_called_soft, prompt_that_holds_the_future, prompt_of_the_next_window,
            all_sentences_called_proved, text_about_something_else, chinese_in_english, split_that_leaks, walk_renamed, pair_lost,
            walk_of_nobody, clock_that_starts_late, weather_that_nobody_drew, night_that_nobody_drew, headings_lost, window_with_a_frame_twice,
            names_of_pictures_exchanged, question_that_looks_ahead, undrawn_event_called_fallback, perturbation_taken_off, pace_called_otherwise,
            time_stretched, pose_of_the_next_frame, poses_of_two_frames_exchanged, lower_than_it_was, pose_frozen,
        )),
        (True, (
            another_camera_all_along, box_against_mask, target_far_behind_on_its_line, poses_of_two_flights_exchanged,
            world_turned, colours_of_neighbours_exchanged, colours_of_two_flights_exchanged, depth_of_neighbours_exchanged,
            instances_of_neighbours_exchanged, instances_exchanged_with_their_boxes, depth_doubled, depth_doubled_but_at_the_person,
            depth_not_a_number, distance_along_the_ray, depth_in_centimetres, empty_instances, person_painted_over,
            person_without_an_instance_of_a_person, jpeg_under_a_png_name, smaller_picture, one_picture_in_two_rows, other_visibility, picture_that_one_sees_through, bytes_behind_a_picture, words_in_a_picture, colours_meant_darker, depth_of_the_twin,
            frame_mirrored_with_its_boxes, depth_a_hundredth_farther, depth_in_decimetres_called_lossless, obstacle_that_is_not_there,
            second_person_far_away, ids_of_things_exchanged, depth_in_centimetres_called_lossless, noise_in_one_depth, visibility_a_little_lower,
            depth_scaled_by_a_fiftieth, depth_set_off, depth_of_a_flight_scaled, thing_farther_in_one_frame, things_of_another_kind_in_a_trajectory,
        )),
    )
    for lie in lies
}  # fmt: skip
