"""Which captions go into a release: the accepted ones, by flight, and an account of all. Only places in the file are
kept in memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from cosfly.formats.captions import ACTIONS, Caption, caption_lines, not_in_set
from cosfly.formats.places import sample_id
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.json_io import dump_json, parse_document, parse_json, validated
from release.columns import LANGUAGES, published_name

FlightKey = tuple[str, str, str]  # town's folder, trajectory, variant
Span = tuple[int, int]  # first byte and size of lines that stand one after the other
ACCEPTED, NO_REASON = "accepted", "no reason given"
MOST_SPAN_BYTES = 4_000_000  # of which the captions are in memory at once


@dataclass
class FlightCaptions:
    """The captions of a track: where the accepted ones stand in the file, and what became of each frame.

    outcomes: By frame, `accepted` or the reason why its caption was dropped.
    """

    path: Path
    outcomes: dict[int, str] = field(default_factory=dict)
    spans: list[Span] = field(default_factory=list)

    def why_none(self, index: int) -> str:
        """Return why a frame has no accepted caption."""
        if not self.outcomes:
            return "the track has no captions"
        if index in self.outcomes:
            return f"dropped: {self.outcomes[index]}"
        asked = min(self.outcomes) <= index <= max(self.outcomes)
        return "not asked for" if asked else "no whole window, at an end of the track"

    def add(self, first: int, size: int) -> None:
        if self.spans and sum(self.spans[-1]) == first and self.spans[-1][1] + size <= MOST_SPAN_BYTES:
            first, size = self.spans[-1][0], self.spans.pop()[1] + size
        self.spans.append((first, size))

    def read(self) -> Iterator[Caption]:
        """Yield them as they stand; raises InputError where they cannot be read any more."""
        for span in self.spans:
            for line in read_bytes(self.path, span=span, what="captions").splitlines():
                value = parse_document(line, self.path)
                yield validated(Caption, value, self.path)


@dataclass
class CaptionAccount:
    """What all captions of a source say of where they come from."""

    dropped: Counter[str] = field(default_factory=Counter)  # reason -> captions
    accepted: int = 0
    of_no_flight: int = 0  # accepted, of flights that are left out
    window_frames: int = 1  # the longest window, from its first frame to its last
    teachers: Counter[tuple[str, str, str]] = field(default_factory=Counter)  # kind, model, settings as JSON
    repairs: Counter[str] = field(default_factory=Counter)  # rung -> accepted captions that it made
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
        if caption.repair is not None and caption.repair.outcome == "repaired":
            self.repairs[caption.repair.rung or caption.repair.strategy] += 1

    def __add__(self, other: CaptionAccount) -> CaptionAccount:
        return CaptionAccount(
            self.dropped + other.dropped,
            self.accepted + other.accepted,
            self.of_no_flight + other.of_no_flight,
            max(self.window_frames, other.window_frames),
            self.teachers + other.teachers,
            self.repairs + other.repairs,
            self.tokens + other.tokens,
            self.asks + other.asks,
        )


def index_captions(
    path: Path,
    lengths: dict[FlightKey, int],
    others: set[FlightKey],
    tell: Callable[[str, InputError], None],
) -> tuple[dict[FlightKey, FlightCaptions], CaptionAccount]:
    """Go over the captions once and note where those of each flight stand.

    Args:
        lengths: of the flights that are released, their frames; others: the flights of the tree that are left out.
        tell: takes what is wrong with a caption, under its sample id.
    """
    found = {key: FlightCaptions(path) for key in lengths}
    account, first = CaptionAccount(), 0
    for line, caption in caption_lines(path):
        size = len(line.encode())
        begin, first = first, first + size
        where = f"{path}: {caption.sample_id}"
        key = (caption.town, caption.trajectory, caption.variant)
        problem = _no_place(caption, key, lengths, others, where)
        if problem is None and caption.status == "accepted":
            problem = _no_caption(caption, where)
            if problem is None and key in found and found[key].outcomes.get(caption.frame_index) == ACCEPTED:
                problem = InputError("the frame has two accepted captions", where=where)
        if problem is not None:
            tell(caption.sample_id, problem)
            continue
        account.add(caption)
        is_accepted = caption.status == ACCEPTED
        if key in found:
            outcome = ACCEPTED if is_accepted else caption.drop_reason or NO_REASON
            found[key].outcomes.setdefault(caption.frame_index, outcome)
            if is_accepted:
                found[key].outcomes[caption.frame_index] = ACCEPTED
                found[key].add(begin, size)
        elif is_accepted:
            account.of_no_flight += 1
    return found, account


def _no_place(
    caption: Caption, key: FlightKey, lengths: dict[FlightKey, int], others: set[FlightKey], where: str
) -> InputError | None:
    """Return why a caption is of no frame of the tree, None if it is of one."""
    if key not in lengths and key not in others:
        return InputError(
            "the track of the caption does not exist", where=where, got="/".join(key),
            expected="a track of the playback tree", fix="pass the captions that were made from this tree",
        )  # fmt: skip
    if not caption.sample_id.endswith(sample_id(f"{caption.trajectory}_{caption.variant}", caption.frame_index)):
        return InputError(
            "the sample_id of the caption does not match its frame", where=where, got=f"frame {caption.frame_index}"
        )
    if not 0 <= caption.frame_index < lengths.get(key, caption.frame_index + 1):
        expected = f"0 to {lengths[key] - 1}" if key in lengths else "0 or more"
        return InputError(
            "the frame of the caption does not exist",
            where=where,
            got=f"frame {caption.frame_index}",
            expected=expected,
        )
    return None


def _no_caption(caption: Caption, where: str) -> InputError | None:
    """Return why an accepted caption cannot be released, None if it can."""
    if caption.en is None or caption.zh is None:
        fix = "caption the tree in both languages, which a release needs"
        return InputError("the accepted caption lacks a language", where=where, fix=fix)
    decision = caption.en.flight_decision
    if decision != caption.zh.flight_decision:
        got = f"{decision} and {caption.zh.flight_decision}"
        return InputError("the two languages of the caption have different decisions", where=where, got=got)
    for name, action in (("en.flight_decision", decision), ("label", caption.label)):
        if action is not None and action not in ACTIONS:
            return not_in_set(action, f"{where}: {name}")
    if caption.verdict == "CONSISTENT" and decision != caption.label:
        return InputError(
            "the verdict is consistent, but decision and label differ",
            where=where,
            got=f"decision {decision}, label {caption.label}",
        )
    window = caption.window
    if not window or window[0] < 0 or window[-1] != caption.frame_index or window != sorted(set(window)):
        expected = f"frames in order of time, the last one {caption.frame_index}"
        return InputError("the window of the caption is invalid", where=where, got=str(window)[:80], expected=expected)
    if any(index <= caption.frame_index for index in caption.future):
        return InputError(
            "the future of the caption does not begin after its window", where=where, got=str(caption.future)[:80]
        )
    if any(language not in caption.prompt for language in LANGUAGES):
        return InputError(
            "the accepted caption lacks a prompt",
            where=where,
            got=f"prompts in {', '.join(caption.prompt) or 'no language'}",
        )
    return None


def teacher_settings(text: str) -> dict:
    """Read the settings of CaptionAccount.teachers."""
    return parse_json(text)
