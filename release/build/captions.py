"""Which captions are released: the accepted ones, by track, and an account of all. Only their places are in memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosfly.formats.captions import ACTIONS, Caption, caption_lines, not_in_set
from cosfly.formats.places import sample_id
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import dump_json, parse_document, validated
from release.build.problems import Problems
from release.columns import LANGUAGES, published_name

FlightKey = tuple[str, str, str]  # town's folder, trajectory, variant
NO_REASON = "no reason given"


@dataclass
class TrackCaptions:
    """The captions of a track, by frame. spans: First byte and size of the accepted ones in the file. dropped: Why the
    others were dropped. before, after: The greatest number of frames that a caption needs before and after its own."""

    path: Path
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)
    dropped: dict[int, str] = field(default_factory=dict)
    before: int = 0
    after: int = 0

    def add(self, caption: Caption, span: tuple[int, int]) -> None:
        """Note where a caption is stored, or why it was dropped."""
        frame = caption.frame_index
        self.before = max(self.before, frame - min(caption.window, default=frame))
        self.after = max(self.after, max(caption.future, default=frame) - frame)
        if caption.status == "accepted":
            self.spans[frame] = span
        else:
            self.dropped.setdefault(frame, caption.drop_reason or NO_REASON)

    def why_none(self, frame: int, num_frames: int) -> str:
        """Return why a frame of a track of so many frames has no accepted caption."""
        if not self.spans and not self.dropped:
            return "the track has no captions"
        if frame in self.dropped:
            return f"dropped: {self.dropped[frame]}"
        is_whole = self.before <= frame < num_frames - self.after
        return "not asked for" if is_whole else "no whole window, at an end of the track"

    def read(self, frame: int) -> Caption:
        """Read the accepted caption of a frame; InputError if it cannot be read any more."""
        line = read_bytes(self.path, span=self.spans[frame], what="captions")
        return validated(Caption, parse_document(line, self.path), self.path)


@dataclass
class CaptionAccount:
    """Counts of all captions and of their teachers."""

    dropped: Counter[str] = field(default_factory=Counter)  # reason -> captions
    accepted: int = 0
    of_no_flight: int = 0  # accepted, of tracks that are not released
    window_frames: int = 1  # the longest window, from its first frame to its last
    teachers: Counter[tuple[str, str, str]] = field(default_factory=Counter)  # kind, model, settings as JSON
    tokens: Counter[str] = field(default_factory=Counter)
    asks: int = 0

    def add(self, caption: Caption) -> None:
        settings = dump_json(caption.teacher.settings.model_dump(mode="json"))
        self.teachers[caption.teacher.kind, published_name(caption.teacher.model), settings] += 1
        self.tokens.update(caption.usage.model_dump())
        self.asks += caption.attempts
        if caption.status != "accepted":
            self.dropped[caption.drop_reason or NO_REASON] += 1
            return
        self.accepted += 1
        self.window_frames = max(self.window_frames, max(caption.window) - min(caption.window) + 1)


def index_captions(
    path: Path,
    found: Mapping[FlightKey, TrackCaptions],
    lengths: Mapping[FlightKey, int],
    others: set[FlightKey],
    account: CaptionAccount,
    problems: Problems,
) -> None:
    """Read the captions of a tree once and note where those of each track are stored.

    Args:
        found: The released tracks, whose captions are added; lengths: Their frames; others: The tracks of the tree that
            are not released. account: Each caption is added.
    """
    first = 0
    for line, caption in caption_lines(path):
        size = len(line.encode())
        begin, first = first, first + size
        key = (caption.town, caption.trajectory, caption.variant)
        is_accepted = caption.status == "accepted"
        try:
            _check_place(caption, key, lengths, others)
            if is_accepted:
                _check_accepted(caption)
            if is_accepted and key in found and caption.frame_index in found[key].spans:
                raise InputError("the frame has two accepted captions")
        except InputError as error:
            error.where = ": ".join(map(str, filter(None, (path, caption.sample_id, error.where))))
            problems.add(caption.sample_id, error)
            continue
        account.add(caption)
        if key in found:
            found[key].add(caption, (begin, size))
        elif is_accepted:
            account.of_no_flight += 1


def _check_place(caption: Caption, key: FlightKey, lengths: Mapping[FlightKey, int], others: set[FlightKey]) -> None:
    """Raise InputError unless a caption is of a frame of the tree."""
    index = caption.frame_index
    if key not in lengths and key not in others:
        raise InputError(
            "the track of the caption does not exist", got="/".join(key), expected="a track of the playback tree",
            fix="pass the captions that were made from this tree",
        )  # fmt: skip
    if not caption.sample_id.endswith(sample_id(f"{caption.trajectory}_{caption.variant}", index)):
        raise InputError("the sample_id of the caption does not match its frame", got=f"frame {index}")
    if not 0 <= index < lengths.get(key, index + 1):
        expected = f"0 to {lengths[key] - 1}" if key in lengths else "0 or more"
        raise InputError("the frame of the caption does not exist", got=f"frame {index}", expected=expected)


def _check_accepted(caption: Caption) -> None:
    """Raise InputError if an accepted caption cannot be released."""
    if caption.en is None or caption.zh is None:
        fix = "caption the tree in both languages, which a release needs"
        raise InputError("the accepted caption lacks a language", fix=fix)
    decision, index, window = caption.en.flight_decision, caption.frame_index, caption.window
    if decision != caption.zh.flight_decision:
        got = f"{decision} and {caption.zh.flight_decision}"
        raise InputError("the two languages of the caption have different decisions", got=got)
    for name, action in (("en.flight_decision", decision), ("label", caption.label)):
        if action is not None and action not in ACTIONS:
            raise not_in_set(action, name)
    if caption.verdict == "CONSISTENT" and decision != caption.label:
        got = f"decision {decision}, label {caption.label}"
        raise InputError("the verdict is consistent, but decision and label differ", got=got)
    if not window or window[0] < 0 or window[-1] != index or window != sorted(set(window)):
        expected = f"frames in order of time, the last one {index}"
        raise InputError("the window of the caption is invalid", got=str(window)[:80], expected=expected)
    if any(later <= index for later in caption.future):
        got = str(caption.future)[:80]
        raise InputError("the future of the caption does not begin after its window", got=got)
    if missing := [language for language in LANGUAGES if language not in caption.prompt]:
        raise InputError("the accepted caption lacks a prompt", got=f"no prompt in {', '.join(missing)}")
