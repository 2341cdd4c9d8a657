"""The captions of the tracks of a release, and an account of all captions. Memory holds only where they are stored."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosfly.formats.captions import Caption, caption_spans
from cosfly.formats.places import sample_id
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import dump_json, parse_document, validated
from release.columns import published_name

FlightKey = tuple[str, str, str]  # town's folder, trajectory, variant
NO_REASON = "no reason given"


@dataclass
class TrackCaptions:
    """The captions of a track, by frame."""

    path: Path
    num_frames: int  # of the track
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)  # of accepted ones: first byte and size in the file
    dropped: dict[int, str] = field(default_factory=dict)  # of the others: why they were dropped
    # Most frames that a caption needs before and after its own: nearer to an end of the track is no whole window.
    before: int = 0
    after: int = 0

    def add(self, caption: Caption, span: tuple[int, int]) -> None:
        """Note where a caption is stored, or why it was dropped."""
        frame = caption.frame_index
        if not 0 <= frame < self.num_frames:
            expected = f"0 to {self.num_frames - 1}"
            raise InputError("the frame of the caption does not exist", got=f"frame {frame}", expected=expected)
        self.before = max(self.before, frame - min(caption.window, default=frame))
        self.after = max(self.after, max(caption.future, default=frame) - frame)
        if caption.status != "accepted":
            self.dropped.setdefault(frame, caption.drop_reason or NO_REASON)
        elif frame in self.spans:
            raise InputError("the frame has two accepted captions", fix="remove one of the two lines")
        else:
            self.spans[frame] = span

    def why_none(self, frame: int) -> str:
        """Return why a frame has no accepted caption."""
        if not self.spans and not self.dropped:
            return "the track has no captions"
        if frame in self.dropped:
            return f"dropped: {self.dropped[frame]}"
        is_whole = self.before <= frame < self.num_frames - self.after
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
    of_other_tracks: int = 0  # accepted ones of tracks that are not released
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
        if caption.window:
            self.window_frames = max(self.window_frames, max(caption.window) - min(caption.window) + 1)


def index_captions(
    path: Path, released: Mapping[FlightKey, TrackCaptions], unreleased: set[FlightKey], account: CaptionAccount
) -> None:
    """Read the captions of a tree once; add those of released tracks to these, and all to the account. InputError if a
    caption is of no track of the tree, lacks a language, or repeats a frame."""
    for span, caption in caption_spans(path):
        key = (caption.town, caption.trajectory, caption.variant)
        try:
            _check(caption, is_known=key in released or key in unreleased)
            if key in released:
                released[key].add(caption, span)
        except InputError as error:
            error.where = f"{path}: {caption.sample_id}"
            raise
        account.add(caption)  # after its checks
        if key in unreleased and caption.status == "accepted":
            account.of_other_tracks += 1


def _check(caption: Caption, *, is_known: bool) -> None:
    """Raise InputError unless a caption is of a track of the tree and, if accepted, in both languages."""
    if not is_known:
        raise InputError(
            "the tree of the run has no track of this caption",
            got="/".join((caption.town, caption.trajectory, caption.variant)), expected="a track of this run's tree",
            fix="pass the captions of this run",
        )  # fmt: skip
    if not caption.sample_id.endswith(sample_id(f"{caption.trajectory}_{caption.variant}", caption.frame_index)):
        got = f"{caption.sample_id} for frame {caption.frame_index}"
        raise InputError("the sample_id of the caption does not match its frame", got=got)
    if caption.status == "accepted" and (caption.en is None or caption.zh is None):
        fix = "run cosfly caption again with both languages: a release needs English and Chinese"
        raise InputError("the accepted caption has no text in one of the two languages", fix=fix)
