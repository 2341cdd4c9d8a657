"""One track to one folder of the playback tree: draw, annotate, encode, write; encoding runs while frames are drawn."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from cosfly.formats import frames
from cosfly.formats.frames import BystandersMeta, Camera, DepthFormat, FrameFile, FrameMeta, Look, TargetMeta
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M, TARGET_HEIGHT_M
from cosfly.formats.people import Appearance, Goal, People
from cosfly.formats.playback import LEGIBILITY, TARGET_FILE, Perturbation, TargetRecord, Track, write_track
from cosfly.formats.segments import Mission, Segment
from cosfly.formats.traces import DroneTrace
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mask_box, world_from_camera
from cosfly.geometry.goals import SeenFrame, find_says, otherwise, target_picture, words_of
from cosfly.geometry.kernels import signed_distances
from cosfly.render.camera import TargetView, contrast_of, legibility, rendered_visibility, view_target
from cosfly.render.contract import FAR_M, NEAR_M, PERSON_ID, Clothes, Frame, Renderer
from cosfly.render.person import DressedBystanders, Gait
from cosfly.render.perturbation import HIDDEN, STEP_UP_M, PerturbedTrack, Poses, Surroundings
from cosfly.runtime.errors import RenderError
from cosfly.runtime.io import sha256_bytes, sha256_file, storage_errors, write_checksums
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.worker import advance
from cosfly.viz.overlay import Overlay

REPORT_FORMAT = FileFormat("cosfly.perturbation_report", "1.0")
MARGIN_M = 60.0  # shadows and sky openness are computed this far around the trajectory
FRAMES_AHEAD = 6  # drawn but not written yet: bounds the memory (about 10 MB each)
TOUCH_M = 0.01  # a camera this deep in a box still touches it only
MOST_GOAL_FRAMES = 8  # the first in which the target is legible
# Two appearances differ to the eye by so many pixels, such a share of a person's, of such a colour difference (CIE76).
DIFFERENT_PX, DIFFERENT_SHARE, DIFFERENT_CONTRAST = 8, 0.04, 10.0


def find_goal(
    people: People, i: int, draw: Callable[[Appearance], Frame], intrinsic: np.ndarray, rotation: np.ndarray
) -> Goal | None:
    """Find the words that distinguish the target of frame i from the bystanders that have a pixel in it.

    Args:
        draw: Draws the frame with a target of that appearance. intrinsic: (3, 3) px. rotation: (3, 3), world from
            camera.
    """
    looks, frame = people.target, draw(people.target)

    @cache
    def differs(other: Appearance) -> bool:
        return targets_differ(frame, draw(other))

    def distinguishes(slot: str, other: Appearance) -> bool:
        if slot == "figure":
            return differs(replace(looks, figure=other.figure))
        kept, worn = ((getattr(one, slot), getattr(one, f"{slot}_color")) for one in (looks, other))
        if kept[1] and worn[1] and kept[1] != worn[1]:  # the wardrobe's colours differ wherever they are visible
            other = otherwise(looks, slot)
        return differs(replace(looks, **{name: getattr(other, name) for name in (slot, f"{slot}_color")}))

    seen = SeenFrame(frame.kinds, frame.ids, frame.depth, intrinsic, rotation)
    says = find_says({PERSON_ID: looks, **people.others}, seen, distinguishes)
    return None if says is None else Goal(i, **words_of(says, looks), says=says)


def targets_differ(frame: Frame, other: Frame) -> bool:
    """Return whether the target of two frames that differ in its appearance only looks different to the eye."""
    is_person = (frame.ids == PERSON_ID) | (other.ids == PERSON_ID)
    colors = [cv2.cvtColor(one.rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)[is_person] for one in (frame, other)]
    num_px = np.count_nonzero(np.linalg.norm(colors[0] - colors[1], axis=-1) >= DIFFERENT_CONTRAST)
    return bool(num_px >= max(DIFFERENT_PX, DIFFERENT_SHARE * np.count_nonzero(is_person)))


def check_track(trace: DroneTrace, surroundings: Surroundings) -> None:
    """Check that in all frames the camera is outside every obstacle and the person not below the ground."""
    depths_m, _ = signed_distances(surroundings.obstacles, trace.positions_m, 0.0)
    feet_m = trace.targets_m - [0.0, 0.0, TARGET_HEIGHT_M]
    below_m = np.array([surroundings.below_ground_m(place) for place in feet_m])
    for what, wrong, amount_m, expected, fix in (
        ("a camera is inside a box", depths_m < -TOUCH_M, -depths_m, "a camera in the open", "plan again on this map"),
        (
            "the target is under the ground", below_m > STEP_UP_M, below_m, "feet on the ground",
            "generate the pedestrian trajectory again on this map",
        ),
    ):  # fmt: skip
        if wrong.any():
            i = int(np.argmax(wrong))
            got = f"{amount_m[i]:.2f} m deep; {np.count_nonzero(wrong)} of {len(wrong)} frames"
            raise RenderError(what, where=f"{trace.path_id}: frame {i}", got=got, expected=expected, fix=fix)


@dataclass(frozen=True)
class TrackScript:
    """All that one track shows, n frames. cameras: of each frame. source: the planner."""

    town: str
    trajectory: str
    variant: str
    cameras: tuple[Camera, ...]
    time_s: np.ndarray
    perturbed: PerturbedTrack
    gait: Gait
    clothes: Clothes
    others: DressedBystanders
    look: Look | None
    is_original: bool
    source: dict
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    weather: WeatherRecord | None = None  # instead of `look`
    between: np.ndarray | None = None  # planned poses that are not drawn (`Track.between`)


@dataclass(frozen=True)
class SeenTarget:
    """The target in one drawn frame: its box, the box of its pixels (4,), and the result of `rendered_visibility`."""

    view: TargetView
    mask_bbox_px: np.ndarray
    visibility: float
    num_pixels: int
    is_visible: bool
    others: BystandersMeta | None


@dataclass(frozen=True)
class Writing:
    """Options of the written files. overlay: draws `debug.png`; None writes none."""

    files: tuple[FrameFile, ...]
    visible_threshold: float
    depth_format: DepthFormat = "png"
    overlay: Overlay | None = None


def render_track(
    renderer: Renderer, script: TrackScript, folder: Path, writing: Writing, num_threads: int = 2
) -> Track:
    """Draw a track into an (unfinished) folder: frames, `trajectory.json`, `perturbation_report.json`,
    `checksums.sha256`.

    A shift that hides a target which is visible without it is dropped: only the drawn frame shows that.

    Returns:
        The track as it was written.
    """
    script = replace(script, perturbed=copy.deepcopy(script.perturbed))  # dropped shifts are noted there
    poses = script.perturbed.poses
    places = np.concatenate([poses.positions_m, poses.targets_m])
    weather = None if script.weather is None else script.weather.params
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M, weather)
    targets: list[TargetMeta] = []
    visibility: list[float] = []
    bystanders: list[dict] = []
    people = script.others.people(script.clothes.looks) if renderer.dresses else None
    pending: list[Future] = []
    digests: dict[str, str] = {}

    def take(written: Future) -> None:
        target, made = written.result()
        targets.append(target)
        digests.update(made)

    with ThreadPoolExecutor(num_threads) as pool:
        for i in range(len(script.time_s)):
            frame, seen = draw_frame(renderer, script, i, poses, writing.visible_threshold)
            if script.perturbed.is_shifted(i) and not seen.is_visible:
                assert script.perturbed.unshifted is not None
                without = draw_frame(renderer, script, i, script.perturbed.unshifted.poses, writing.visible_threshold)
                if without[1].is_visible:
                    script.perturbed.drop_shift(i, HIDDEN)
                    frame, seen = without
            visibility.append(seen.visibility)
            others = {} if seen.others is None else {"others": seen.others.people_of(poses.targets_m[i], people)}
            bystanders.append(others)
            pending.append(pool.submit(_write_frame, folder, frame, annotation(script, i, seen), writing, script))
            advance()
            while len(pending) >= FRAMES_AHEAD:
                take(pending.pop(0))
        for written in pending:
            take(written)
    track = _track(script, targets, np.array(visibility), bystanders)
    track = _with_goal(track, renderer, script, writing.visible_threshold)
    write_track(folder, track)
    write_json(folder / "perturbation_report.json", _report(script.perturbed))
    made = ["trajectory.json", "perturbation_report.json"]
    if track.goal is not None and "rgb" in writing.files:
        box, rgb = targets[track.goal.frame].mask_bbox_2d, frames.read_rgb(folder / frames.frame_name(track.goal.frame))
        assert box is not None, "the target is legible there"
        (folder / TARGET_FILE).write_bytes(frames.rgb_bytes(target_picture(rgb, box)))
        made.append(TARGET_FILE)
    for name in made:
        digests[name] = sha256_file(folder / name)
    write_checksums(folder, digests)
    return track


def draw_frame(
    renderer: Renderer, script: TrackScript, i: int, poses: Poses, threshold: float
) -> tuple[Frame, SeenTarget]:
    """Draw frame i from the given poses and measure how visible the target is."""
    pose, target = world_from_camera(poses.positions_m[i], poses.rotations_deg[i]), poses.targets_m[i]
    camera = script.cameras[i]
    person, others = script.gait.posed(i, target, script.clothes), script.others.posed(i)
    frame = renderer.render(pose, camera.intrinsic, person, others)
    view = view_target(target, pose, camera)
    ids = np.array([other.instance_id for other in others], dtype=np.int64)
    score, *hidden = rendered_visibility(frame, target, view, pose, camera, ids)
    is_person = frame.ids == PERSON_ID
    num_px = int(np.count_nonzero(is_person))
    # A thin pole may hide the person and not the box: both depth and mask must show the target.
    is_visible = view.in_view and score > threshold and num_px > 0
    bystanders = script.others.meta(i, frame, *hidden) if others else None
    return frame, SeenTarget(view, mask_box(is_person), score, num_px, is_visible, bystanders)


def _with_goal(track: Track, renderer: Renderer, script: TrackScript, threshold: float) -> Track:
    """Add the goal, from the first frame in which the target is legible and distinct, or the reason for its absence."""
    if not renderer.dresses:
        return replace(track, people=None, raw=track.raw | {"goal": {"absent": "clothes_unknown"}})
    poses, people = script.perturbed.poses, script.others.people(script.clothes.looks)
    legible = [i for i in range(len(track)) if track.legibility_at(i)["legible"]]
    for i in legible[:MOST_GOAL_FRAMES]:

        def draw(looks: Appearance, i: int = i) -> Frame:
            dressed = replace(script, clothes=replace(script.clothes, looks=looks))
            return draw_frame(renderer, dressed, i, poses, threshold)[0]

        rotation = world_from_camera(poses.positions_m[i], poses.rotations_deg[i])[:3, :3]
        if goal := find_goal(people, i, draw, script.cameras[i].intrinsic, rotation):
            return replace(track, goal=goal)
        advance()
    return replace(track, raw=track.raw | {"goal": {"absent": "not_told_apart" if legible else "never_legible"}})


# --- files of one frame -----------------------------------------------------------------------------------------------


def _write_frame(
    folder: Path, frame: Frame, meta: FrameMeta, writing: Writing, script: TrackScript
) -> tuple[TargetMeta, dict[str, str]]:
    """Encode and write one frame, in a thread; return the target's annotation, and file name -> sha256."""
    name, is_person = frames.frame_name(meta.index), frame.ids == PERSON_ID
    person = meta.target.model_copy(update=legibility(meta.target, contrast_of(frame.rgb, is_person)))
    meta = meta.model_copy(update={"target": person})
    makers: dict[FrameFile, Callable[[], tuple[str, bytes]]] = {
        "rgb": lambda: (frames.FILE_NAMES["rgb"], frames.rgb_bytes(frame.rgb)),
        "depth": lambda: frames.depth_file(frame.depth, writing.depth_format),
        "instance": lambda: (frames.FILE_NAMES["instance"], frames.instance_bytes(frame.kinds, frame.ids)),
    }
    contents = dict(makers[file]() for file in writing.files)
    if writing.overlay is not None:
        debug = writing.overlay.draw(frame.rgb, frame.ids, meta)
        contents[frames.DEBUG_FILE] = frames.rgb_bytes(debug)
    contents["meta.json"] = meta.to_bytes()
    target = folder / name
    with storage_errors(target):
        target.mkdir(parents=True, exist_ok=True)
        for file_name, data in contents.items():
            # No fsync here: the track's folder gets its final name only when all of it is written.
            (target / file_name).write_bytes(data)
    return person, {f"{name}/{file_name}": sha256_bytes(data) for file_name, data in contents.items()}


# --- annotations ------------------------------------------------------------------------------------------------------


def annotation(script: TrackScript, i: int, seen: SeenTarget) -> FrameMeta:
    """Return the content of `meta.json` of frame i."""
    perturbed, view = script.perturbed, seen.view
    return FrameMeta(
        index=i,
        time_s=float(script.time_s[i]),
        town=script.town,
        trajectory=script.trajectory,
        variant=script.variant,
        camera=frames.camera_meta(script.cameras[i], NEAR_M, FAR_M),
        drone_pose=np.hstack([perturbed.poses.positions_m[i], perturbed.poses.rotations_deg[i]]),
        target=TargetMeta(
            world_location=perturbed.poses.targets_m[i],
            half_extents_m=PERSON_HALF_EXTENTS_M,
            instance_id=PERSON_ID,
            semantic_id=KINDS["Pedestrians"],
            image_uv=_list_or_none(view.uv),
            bbox_2d=_list_or_none(view.bbox_px),
            mask_bbox_2d=_list_or_none(seen.mask_bbox_px),
            depth_m=view.depth_m,
            in_view=view.in_view,
            visible=seen.is_visible,
            visibility=round(seen.visibility, 6),
            num_pixels=seen.num_pixels,
        ),
        perturbation=frames.PerturbationMeta(
            **perturbed.states[i],
            drone_position=perturbed.drone_offsets_m[i],
            target_position=perturbed.target_offsets_m[i],
            drone_rotation=perturbed.rotation_offsets_deg[i],
        ),
        look=script.look,
        others=seen.others,
        weather=script.weather,
    )


def _list_or_none(values: np.ndarray) -> list[float] | None:
    return None if np.isnan(values).any() else values.tolist()


def _report(perturbed: PerturbedTrack) -> dict:
    """Return `perturbation_report.json`: counts of events, and the least clearance of the drone."""
    outcomes = {event: Counter(state[event] for state in perturbed.states) for event in ("position", "rotation")}
    return {
        **REPORT_FORMAT.header,
        "num_frames": len(perturbed.states),
        "num_perturbed": int(perturbed.is_perturbed.sum()),
        "clearance_min_m": round(float(perturbed.poses.clearances_m.min()), 4),
        **{event: dict(sorted(counts.items())) for event, counts in outcomes.items()},
    }


def _track(script: TrackScript, targets: list[TargetMeta], visibility: np.ndarray, bystanders: list[dict]) -> Track:
    perturbed = script.perturbed
    zooms = any(camera is not script.cameras[0] for camera in script.cameras)
    return Track(
        town=script.town,
        trajectory=script.trajectory,
        variant=script.variant,
        camera=script.cameras[0],
        intrinsics=np.array([camera.intrinsic for camera in script.cameras]) if zooms else None,
        time_s=script.time_s,
        positions_m=perturbed.poses.positions_m,
        rotations_deg=perturbed.poses.rotations_deg,
        targets_m=perturbed.poses.targets_m,
        target=TargetRecord(
            in_view=np.array([target.in_view for target in targets]),
            visible=np.array([target.visible for target in targets]),
            depth_m=np.array([target.depth_m for target in targets]),
            uv=np.array([target.image_uv or [np.nan] * 2 for target in targets]),
            bbox=np.array([target.bbox_2d or [np.nan] * 4 for target in targets]),
            visibility=visibility,
            mask_bbox=np.array([target.mask_bbox_2d or [np.nan] * 4 for target in targets]),
        ),
        perturbation=Perturbation(
            perturbed.is_perturbed,
            perturbed.drone_offsets_m,
            perturbed.rotation_offsets_deg,
            perturbed.target_offsets_m,
        ),
        source=script.source,
        segments=script.segments,
        mission=script.mission,
        people=script.others.people(script.clothes.looks),
        between=script.between,
        is_original=script.is_original,
        raw={
            **({} if script.weather is None else {"weather": script.weather.model_dump()}),
            "points": [
                {"perturbation": dict(state), "target": target.model_dump(include=set(LEGIBILITY)), **others}
                for state, target, others in zip(perturbed.states, targets, bystanders, strict=True)
            ],
        },
    )
