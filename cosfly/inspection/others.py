"""Checks on who else moves in a flight: do they keep clear of drone and person, and what do they hide of the person?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cosfly.products.frames import FrameMeta, OtherMeta, OthersMeta
from cosfly.products.issues import Report
from cosfly.products.kinds import KIND_NAMES
from cosfly.products.others import BUILDS, Other, distances_to_boxes_m
from cosfly.products.playback import Flight
from cosfly.space.flight_metrics import CLEARANCE_TOLERANCE_M


def others_told(flight: Flight, metas: Mapping[int, FrameMeta | None]) -> dict[int, OthersMeta]:
    """Give what the annotations of frames tell of others, by frame; empty for a flight without, and for one of somebody else."""
    if not flight.is_ours:
        return {}
    return {i: meta.others for i, meta in metas.items() if meta is not None and meta.others is not None}


def check_others(
    flight: Flight, told: dict[int, OthersMeta], clearance_min_m: float, report: Report, metrics: dict
) -> None:
    """Measure how near others come to drone and person, and add what they hide of the person."""
    nearest_m = np.inf
    for i, frame in told.items():
        for line in frame.others:
            other = _other(line)
            if other is None:
                where = f"meta.json of frame {i}: others"
                report.error("broken_annotation", where, f"semantic_id {line.semantic_id}", " or ".join(BUILDS))
                continue
            distance_m = float(distances_to_boxes_m(flight.positions_m[i], other)[0])
            nearest_m = min(nearest_m, distance_m)
            if distance_m < clearance_min_m - CLEARANCE_TOLERANCE_M:
                where, expected = (
                    f"trajectory.json: points[{i}].drone_pose",
                    f"at least {clearance_min_m:g} m to others",
                )
                report.error("clearance", where, f"{distance_m:.2f} m to {line.instance_id}", expected)
            if other.gap_to_person_m(flight.targets_m[i]) < -CLEARANCE_TOLERANCE_M:
                where = f"trajectory.json: points[{i}].target.world_location"
                report.error("collision", where, f"in {line.instance_id}", "a person who touches nobody")
    if told:
        hidden = np.array([frame.target_hidden_by_others for frame in told.values()])
        metrics.update(
            num_others=max(len(frame.others) for frame in told.values()),
            others_clearance_min_m=nearest_m if np.isfinite(nearest_m) else None,
            occluded_by_others_share=float((hidden > 0).mean()),
            hidden_by_others_max=float(hidden.max()),
        )


def _other(line: OtherMeta) -> Other | None:
    """The other of an annotation in right-handed axes; None of an unknown kind."""
    kind = KIND_NAMES.get(line.semantic_id, "")
    if kind not in BUILDS:
        return None
    feet_m = line.center_m - np.array([0.0, 0.0, BUILDS[kind].half_extents_m[2]])
    return Other(kind, feet_m[None], np.array([line.heading_rad]))
