"""`report.html` of the inspection: one self-contained page without scripts for the reviewer.

It shows the figures, the issues and three pictures of each track; `viewer.html` has its trajectory on the map.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, Field

from cosfly.formats.inspection import RESULTS, Inspection
from cosfly.formats.issues import Issue, sort_key
from cosfly.formats.playback import Track
from cosfly.runtime.io import read_text
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page

STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))
MOST_SHOWN = 400  # tracks with pictures, 0.06 MB each

# column title, metric, format
COLUMNS = (
    ("frames", "num_frames", "{:.0f}"), ("m", "length_m", "{:.1f}"), ("a m/s²", "accel_rms_mps2", "{:.2f}"),
    ("j m/s³", "jerk_rms_mps3", "{:.2f}"), ("S", "smoothness", "{:.3f}"), ("clear m", "clearance_min_m", "{:.2f}"),
    ("five-ray", "five_ray_mean", "{:.3f}"), ("rendered", "rendered_visibility_mean", "{:.3f}"),
    ("visible", "visible_share", "{:.0%}"), ("legible", "legible_share", "{:.0%}"), ("IoU", "track_quality", "{:.2f}"),
)  # fmt: skip
OF_FRAME = re.compile(r"(?:frame_|points\[|frame )(\d+)")  # the frame's index in `where` of an issue
BETWEEN_FRAMES = ("temporal_jump", "frozen_frame", "teleport")


class ReportPicture(BaseModel):
    """One picture of a track."""

    frame: int
    jpeg: str | None = Field(pattern=r"^[A-Za-z0-9+/=]*$")  # in base64; None: the file is unreadable
    of_issue: bool  # whether an issue names the frame


def pictures_of(track: Track, width_px: int, issues: Sequence[Issue]) -> list[ReportPicture]:
    """Return three pictures of a width, first of the frames of issues, then of the first, middle and last frame."""
    issue_frames = frames_of_issues(issues, len(track))
    frames = sorted([*issue_frames, 0, len(track) // 2, len(track) - 1][:3])
    return [
        ReportPicture(frame=i, jpeg=thumbnail(track.frame_folder(i), width_px), of_issue=i in issue_frames)
        for i in frames
    ]


def frames_of_issues(issues: Sequence[Issue], num_frames: int) -> list[int]:
    """Return the frames of issues, the worst first. An issue between two frames has both."""
    frames: dict[int, None] = {}  # an ordered set
    for issue in sorted(issues, key=sort_key):
        match = OF_FRAME.search(issue.where)
        if match is None or issue.severity == "note" or int(match[1]) >= num_frames:
            continue
        if issue.code in BETWEEN_FRAMES:
            frames[max(int(match[1]) - 1, 0)] = None
        frames[int(match[1])] = None
    return list(frames)


def report_html(name: str, inspection: Inspection, pictures: Mapping[str, Sequence[ReportPicture]]) -> str:
    """Return the page, with the tracks that need a decision first. pictures: by track folder."""
    tracks = sorted(inspection.flights, key=lambda track: (-RESULTS.index(track.result), track.folder))
    shown = {track.folder: pictures[track.folder] for track in tracks[:MOST_SHOWN] if track.folder in pictures}
    return page(
        "cosfly/inspection/report.html", title=name, style=STYLE, inspection=inspection, results=RESULTS,
        columns=COLUMNS, tracks=tracks, shown=shown, num_without_pictures=len(pictures) - len(shown),
    )  # fmt: skip
