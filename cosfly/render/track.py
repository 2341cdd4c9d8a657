"""One track to one folder of the playback tree: draw, annotate, encode, write; encoding runs while frames are drawn."""

import copy
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from cosfly.formats import frames
from cosfly.formats.frames import BystandersMeta, Camera, FrameMeta, Look, TargetMeta
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M, pace_field
from cosfly.formats.people import Appearance, Goal, People
from cosfly.formats.playback import LEGIBILITY, TARGET_FILE, Perturbation, TargetRecord, Track
from cosfly.formats.playback_file import write_track
from cosfly.formats.traces import DroneTrace
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import mask_box, world_from_camera
from cosfly.geometry.goals import SeenFrame, find_says, otherwise, target_picture, words_of
from cosfly.render.camera import contrast_of, legibility, rendered_visibility, view_target
from cosfly.render.contract import FAR_M, NEAR_M, PERSON_ID, Clothes, Frame, Renderer
from cosfly.render.person import DressedBystanders, Gait
from cosfly.render.perturbation import HIDDEN, PERTURBED, PerturbedTrack, Poses
from cosfly.render.settings import RenderConfig
from cosfly.runtime.io import sha256_bytes, sha256_file, storage_errors, write_checksums
from cosfly.runtime.worker import advance

VARIANTS = {"clean": "ORI", "perturbed": PERTURBED}
MARGIN_M = 60.0  # shadows and sky openness are computed this far around the trajectory
ENCODER_THREADS = 2  # of each worker, next to the drawing
FRAMES_AHEAD = 6  # drawn but not written yet: bounds the memory (about 10 MB each)
MOST_GOAL_FRAMES = 8  # the first in which the target is legible
GOAL_LEAST_PX = 24  # a goal in words names what at least this many pixels show
# Two appearances differ to the eye if enough pixels of the person differ in colour.
DIFFERENT_SHARE = 0.04  # least share of the person's pixels
DIFFERENT_CONTRAST = 10.0  # least difference of a pixel (CIE76)


@dataclass(frozen=True)
class TrackScript:
    """All that one track shows."""

    town: str
    trajectory: str
    variant: str
    path_index: int  # of the trajectory in its file
    trace: DroneTrace  # its drawn poses
    cameras: tuple[Camera, ...]  # one per frame
    perturbed: PerturbedTrack
    gait: Gait
    clothes: Clothes
    bystanders: DressedBystanders
    look: Look | None  # None with a weather
    weather: WeatherRecord | None


def render_track(renderer: Renderer, script: TrackScript, folder: Path, cfg: RenderConfig) -> Track:
    """Draw a track into a folder: frames, `trajectory.json`, `checksums.sha256`.

    A shift is dropped if it hides a target that is visible without it, which only the drawn frame shows.

    Returns:
        The track as it was written.
    """
    poses = script.perturbed.poses
    places = np.concatenate([poses.positions_m, poses.targets_m])
    weather = None if script.weather is None else script.weather.params
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M, weather)
    drawn = _draw_frames(renderer, script, folder, cfg)
    script = replace(script, perturbed=drawn.perturbed)
    track = _with_goal(_track(script, drawn), renderer, script, cfg)
    write_track(folder, track)
    file_names = ["trajectory.json"]
    if track.goal is not None and "rgb" in cfg.modalities:
        _write_target_picture(folder, track.goal.frame, drawn.targets[track.goal.frame])
        file_names.append(TARGET_FILE)
    write_checksums(folder, drawn.digests | {name: sha256_file(folder / name) for name in file_names})
    return track


def _write_target_picture(folder: Path, i: int, target: TargetMeta) -> None:
    """Write the part of frame i that shows the target, which is legible there."""
    assert target.mask_bbox_2d is not None
    rgb = frames.read_rgb(folder / frames.frame_name(i))
    (folder / TARGET_FILE).write_bytes(frames.rgb_bytes(target_picture(rgb, target.mask_bbox_2d)))


# --- frames -----------------------------------------------------------------------------------------------------------


class DrawnFrame(NamedTuple):
    """A frame and its annotations; that of the target is without its legibility."""

    frame: Frame
    target: TargetMeta
    bystanders: BystandersMeta | None  # None: the track has none


@dataclass
class DrawnFrames:
    """What remains in memory of the frames of a track."""

    perturbed: PerturbedTrack  # without the shifts that hide the target
    targets: list[TargetMeta] = field(default_factory=list)  # as written
    visibility: list[float] = field(default_factory=list)  # of the targets, not rounded
    point_fields: list[dict[str, Any]] = field(default_factory=list)  # bystanders in the points of `trajectory.json`
    digests: dict[str, str] = field(default_factory=dict)  # file -> sha256


def _draw_frames(renderer: Renderer, script: TrackScript, folder: Path, cfg: RenderConfig) -> DrawnFrames:
    """Draw and write all frames, encoding in threads; drop the shifts that hide the target."""
    perturbed = copy.deepcopy(script.perturbed)
    script = replace(script, perturbed=perturbed)
    people = script.bystanders.people(script.clothes.looks) if renderer.dresses else None
    drawn = DrawnFrames(perturbed)
    pending = deque[Future]()

    def collect_oldest() -> None:
        target, file_digests = pending.popleft().result()
        drawn.targets.append(target)
        drawn.digests.update(file_digests)

    with ThreadPoolExecutor(ENCODER_THREADS) as pool:
        for i in range(len(script.trace.time_s)):
            frame = draw_frame(renderer, script, i, perturbed.poses, cfg.visible_threshold)
            if perturbed.is_shifted(i) and not frame.target.visible:
                assert perturbed.unshifted is not None
                unshifted = draw_frame(renderer, script, i, perturbed.unshifted.poses, cfg.visible_threshold)
                if unshifted.target.visible:
                    perturbed.drop_shift(i, HIDDEN)
                    frame = unshifted
            drawn.visibility.append(frame.target.visibility)
            point_fields = {}
            if frame.bystanders is not None:
                point_fields["others"] = frame.bystanders.people_of(perturbed.poses.targets_m[i], people)
            drawn.point_fields.append(point_fields)
            pending.append(pool.submit(_write_frame, folder, frame.frame, _annotation(script, i, frame), cfg))
            advance()
            while len(pending) >= FRAMES_AHEAD:
                collect_oldest()
        while pending:
            collect_oldest()
    return drawn


def draw_frame(renderer: Renderer, script: TrackScript, i: int, poses: Poses, visible_threshold: float) -> DrawnFrame:
    """Draw frame i from the given poses; annotate the target and the bystanders."""
    pose = world_from_camera(poses.positions_m[i], poses.rotations_deg[i])
    target_m = poses.targets_m[i]
    camera = script.cameras[i]
    target = script.gait.posed(i, target_m, script.clothes)
    bystanders = script.bystanders.posed(i)
    frame = renderer.render(pose, camera.intrinsic, {PERSON_ID: target, **bystanders})
    view = view_target(target_m, pose, camera)
    ids = np.array(list(bystanders), dtype=np.int64)
    visibility = rendered_visibility(frame, target_m, view, pose, camera, ids)
    is_person = frame.ids == PERSON_ID
    num_px = int(np.count_nonzero(is_person))
    # A thin pole may hide the person and not the box: both depth and mask must show the target.
    is_visible = view.in_view and visibility.score > visible_threshold and num_px > 0
    target_meta = TargetMeta(
        world_location=target_m, half_extents_m=PERSON_HALF_EXTENTS_M, instance_id=PERSON_ID,
        semantic_id=KINDS["Pedestrians"], image_uv=_list_or_none(view.uv), bbox_2d=_list_or_none(view.bbox_px),
        mask_bbox_2d=_list_or_none(mask_box(is_person)), depth_m=view.depth_m, in_view=view.in_view, visible=is_visible,
        visibility=visibility.score, num_pixels=num_px,
    )  # fmt: skip
    bystanders_meta = script.bystanders.meta(i, frame, visibility) if bystanders else None
    return DrawnFrame(frame, target_meta, bystanders_meta)


def _list_or_none(values: np.ndarray) -> list[float] | None:
    return None if np.isnan(values).any() else values.tolist()


def written_target(target: TargetMeta, frame: Frame) -> TargetMeta:
    """Return the annotation of a drawn target as it is written: with its legibility, and rounded."""
    target = target.model_copy(update={"visibility": round(target.visibility, 6)})
    return target.model_copy(update=legibility(target, contrast_of(frame.rgb, frame.ids == PERSON_ID)))


def _annotation(script: TrackScript, i: int, drawn: DrawnFrame) -> FrameMeta:
    """Return `meta.json` of frame i, without the target's legibility, which takes time and is added in a thread."""
    perturbed = script.perturbed
    perturbation = frames.PerturbationMeta(
        **perturbed.states[i], drone_position=perturbed.drone_offsets_m[i],
        target_position=perturbed.target_offsets_m[i], drone_rotation=perturbed.rotation_offsets_deg[i],
    )  # fmt: skip
    return FrameMeta(
        index=i, time_s=float(script.trace.time_s[i]), town=script.town, trajectory=script.trajectory,
        variant=script.variant, camera=frames.camera_meta(script.cameras[i], NEAR_M, FAR_M),
        drone_pose=np.hstack([perturbed.poses.positions_m[i], perturbed.poses.rotations_deg[i]]), target=drawn.target,
        perturbation=perturbation, look=script.look, others=drawn.bystanders, weather=script.weather,
    )  # fmt: skip


def _write_frame(folder: Path, frame: Frame, meta: FrameMeta, cfg: RenderConfig) -> tuple[TargetMeta, dict[str, str]]:
    """Encode and write one frame, in a thread; return the target's annotation, and file name -> sha256."""
    name = frames.frame_name(meta.index)
    meta = meta.model_copy(update={"target": written_target(meta.target, frame)})
    contents: dict[str, bytes] = {}
    if "rgb" in cfg.modalities:
        contents[frames.FILE_NAMES["rgb"]] = frames.rgb_bytes(frame.rgb)
    if "depth" in cfg.modalities:
        contents |= [frames.depth_file(frame.depth, cfg.depth_format)]
    if "instance" in cfg.modalities:
        contents[frames.FILE_NAMES["instance"]] = frames.instance_bytes(frame.kinds, frame.ids)
    contents["meta.json"] = meta.to_bytes()
    with storage_errors(folder / name):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for file_name, data in contents.items():
            # No fsync here: the track's folder gets its final name only when all of it is written.
            (folder / name / file_name).write_bytes(data)
    return meta.target, {f"{name}/{file_name}": sha256_bytes(data) for file_name, data in contents.items()}


def _track(script: TrackScript, drawn: DrawnFrames) -> Track:
    """Return the track of a script and its frames, without a goal."""
    perturbed = script.perturbed
    trace = script.trace
    cameras = script.cameras
    zooms = any(camera is not cameras[0] for camera in cameras)

    def column(name: str, num: int = 1) -> np.ndarray:
        """Return a field of `num` values of each target, (n, num), NaN where it is None."""
        values = [getattr(target, name) for target in drawn.targets]
        return np.array([[np.nan] * num if value is None else value for value in values])

    target_record = TargetRecord(
        visibility=np.array(drawn.visibility), uv=column("image_uv", 2), bbox=column("bbox_2d", 4),
        mask_bbox=column("mask_bbox_2d", 4), **{name: column(name) for name in ("in_view", "visible", "depth_m")},
    )  # fmt: skip
    offsets = perturbed.drone_offsets_m, perturbed.rotation_offsets_deg, perturbed.target_offsets_m
    source = {
        "path_index": script.path_index,
        "scenario_id": trace.path_id,
        "scenario_name": script.town,
        "algorithm": trace.planner,
        "clearance_min_m": trace.metrics.get("clearance_min_m"),
        **pace_field(trace.pace),
    }
    weather = {} if script.weather is None else {"weather": script.weather.model_dump()}
    points = [
        {"perturbation": dict(state), "target": target.model_dump(include=set(LEGIBILITY)), **point_fields}
        for state, target, point_fields in zip(perturbed.states, drawn.targets, drawn.point_fields, strict=True)
    ]
    return Track(
        town=script.town, trajectory=script.trajectory, variant=script.variant,
        camera=cameras[0], intrinsics=np.array([camera.intrinsic for camera in cameras]) if zooms else None,
        time_s=trace.time_s, positions_m=perturbed.poses.positions_m, rotations_deg=perturbed.poses.rotations_deg,
        targets_m=perturbed.poses.targets_m, target=target_record,
        perturbation=Perturbation(perturbed.is_perturbed, *offsets), source=source,
        segments=trace.segments, mission=trace.mission, people=script.bystanders.people(script.clothes.looks),
        is_original=script.variant == VARIANTS["clean"], raw={**weather, "points": points},
    )  # fmt: skip


# --- the goal in words ------------------------------------------------------------------------------------------------


def _with_goal(track: Track, renderer: Renderer, script: TrackScript, cfg: RenderConfig) -> Track:
    """Add the goal, from the first frame in which the target is legible and distinct, or the reason for its absence."""
    if not renderer.dresses:
        return replace(track, people=None, raw=track.raw | {"goal": {"absent": "clothes_unknown"}})
    people = script.bystanders.people(script.clothes.looks)
    legible = [i for i in range(len(track)) if track.legibility_at(i)["legible"]]
    for i in legible[:MOST_GOAL_FRAMES]:
        redraw = partial(_draw_dressed, renderer, script, i, cfg.visible_threshold)
        if goal := find_goal(people, i, redraw, GOAL_LEAST_PX):
            return replace(track, goal=goal)
        advance()
    return replace(track, raw=track.raw | {"goal": {"absent": "not_told_apart" if legible else "never_legible"}})


def _draw_dressed(
    renderer: Renderer, script: TrackScript, i: int, visible_threshold: float, instance_id: int, looks: Appearance
) -> Frame:
    """Draw frame i with one person in another appearance."""
    if instance_id == PERSON_ID:
        dressed = replace(script, clothes=replace(script.clothes, looks=looks))
    else:
        dressed = replace(script, bystanders=script.bystanders.dressed(instance_id, looks))
    return draw_frame(renderer, dressed, i, script.perturbed.poses, visible_threshold).frame


def find_goal(people: People, i: int, redraw: Callable[[int, Appearance], Frame], least_px: int) -> Goal | None:
    """Find the words that distinguish the target of frame i from the bystanders that have a pixel in it.

    Words name only what the picture shows: the frame is drawn again with a person in another appearance, and compared.

    Args:
        redraw: Draws the frame with the person of an instance id in that appearance.
        least_px: Fewest pixels by which a person shows a garment or the figure. A bystander of fewer pixels is taken as
            different from the target where the records differ.
    """
    comparison = _Comparison(people, redraw, least_px)
    target_differs = partial(comparison.differs_in_slot, PERSON_ID)
    seen = SeenFrame(comparison.frame.ids, comparison.frame.depth)
    says = find_says(comparison.people, seen, target_differs, comparison.bystander_differs)  # slots that tell it apart
    return None if says is None else Goal(i, **words_of(says, people.target), says=says)


class _Comparison:
    """What people look like in one frame."""

    def __init__(self, people: People, redraw: Callable[[int, Appearance], Frame], least_px: int) -> None:
        self.people = {PERSON_ID: people.target, **people.others}  # by instance id
        self.frame = frame = redraw(PERSON_ID, people.target)
        self._least_px = least_px

        # The search asks for the same appearance again. A cached method would keep this object alive, and its frame.
        @cache
        def differs(instance_id: int, looks: Appearance) -> bool:
            return people_differ(frame, redraw(instance_id, looks), instance_id, least_px)

        self._differs = differs

    def bystander_differs(self, slot: str, instance_id: int) -> bool:
        """Return whether a bystander looks unlike the target in a slot, or is too small to be seen."""
        is_small = np.count_nonzero(self.frame.ids == instance_id) < self._least_px
        return bool(is_small) or self.differs_in_slot(instance_id, slot, self.people[PERSON_ID])

    def differs_in_slot(self, instance_id: int, slot: str, other: Appearance) -> bool:
        """Return whether a person would look different with what another appearance has in a slot."""
        person = self.people[instance_id]
        if slot == "figure":
            return self._differs(instance_id, replace(person, figure=other.figure))
        color_field = f"{slot}_color"
        color, other_color = getattr(person, color_field), getattr(other, color_field)
        # The wardrobe's colours differ wherever they are visible. Whether this slot is visible is the same question for
        # all other colours, so it is asked of one appearance, and `_differs` draws it once.
        if color and other_color and color != other_color:
            other = otherwise(person, slot)
        changes = {name: getattr(other, name) for name in (slot, color_field)}
        return self._differs(instance_id, replace(person, **changes))


def people_differ(frame: Frame, other: Frame, instance_id: int, least_px: int) -> bool:
    """Return whether a person looks different to the eye in two frames that differ in its appearance only."""
    is_person = (frame.ids == instance_id) | (other.ids == instance_id)
    lab, other_lab = (
        cv2.cvtColor(picture.rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)[is_person] for picture in (frame, other)
    )
    num_px = np.count_nonzero(np.linalg.norm(lab - other_lab, axis=-1) >= DIFFERENT_CONTRAST)
    return bool(num_px >= max(least_px, DIFFERENT_SHARE * np.count_nonzero(is_person)))
