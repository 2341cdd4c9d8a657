"""Captions to a training set: one sample per window and language, in splits that share no pedestrian trajectory.

Needs no torch. Pictures are not copied: a sample names frames of a playback tree. Its prompt is that of the caption,
with the sentence about the pictures that the student gets.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import Field, model_validator

from cosfly.formats.captions import Caption, Language, Place, Verdict, read_captions
from cosfly.formats.frames import frame_name, frame_path
from cosfly.formats.places import Place as TrackPlace
from cosfly.formats.places import flight_ids, sample_id
from cosfly.formats.playback import Track, read_track
from cosfly.formats.predictions import Split
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.splits import SPLITS, Course, walks_of
from cosfly.inspection.blind_baseline import past_of
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside
from cosfly.runtime.json_io import dump_json, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally, fingerprint, record_of
from cosfly.viz.frame_views import DEPTH_RANGE_M, VIEW_FILES, Pictures, View, scaled_size
from distill.prepare.sources import RunSource, SplitConfig, check_names, inputs_of
from distill.schema import RECORD, RECORD_FORMAT, Sample, SourceTree, SplitWriter, TrainingSet, write_page

log = logging.getLogger(__name__)

STAGE = "distill.prepare"
DIGITS = 4  # of a past: a tenth of a millimetre, as trees have it
PAGE_TEXT = "`prompt` is the question, `answer` the expected answer. No two splits share a {}."


class PrepareConfig(SplitConfig):
    """Settings of `distill prepare`."""

    languages: tuple[Language, ...] = Field(
        ("en", "zh"), min_length=1, description="languages of the answers; each gives its own samples"
    )
    decision: Place = Field(
        "first", description="place of the decision among the fields of an answer; a student answers in this order"
    )
    modalities: tuple[View, ...] = Field(
        ("rgb",),
        description="pictures of each frame, in this order; middle: the middle third of rgb; empty: only text",
    )
    text_state: bool = Field(True, description="the prompt contains the measured flight data; false: only pictures")
    verdicts: tuple[Verdict, ...] = Field(
        ("CONSISTENT", "SOFT_CONFLICT", "ABSTAIN"), min_length=1, description="verdicts of the captions to use"
    )
    limit: int = Field(0, ge=0, description="number of windows in all splits, chosen at random; 0: all")

    @model_validator(mode="after")
    def _there_is_something_to_learn(self) -> PrepareConfig:
        if not self.modalities and not self.text_state:
            raise ValueError("modalities must not be empty if text_state is false")
        if len(set(self.languages)) < len(self.languages) or len(set(self.modalities)) < len(self.modalities):
            raise ValueError("languages and modalities must not repeat an entry")
        return self


# --- samples ----------------------------------------------------------------------------------------------------------


def make_sample(
    caption: Caption, language: Language, cfg: PrepareConfig, *, run: str = "", walk: str = "", sample_id: str = ""
) -> Sample | str:
    """Return the sample of a caption in one language, or the reason why there is none.

    Args:
        run, walk: of its track. sample_id: unique among the samples of all runs; "": that of the caption.
    """
    values = (caption.checks.values or {}).get(language)
    if caption.status != "accepted":
        return f"dropped_{caption.drop_reason or 'unknown'}"
    if caption.verdict not in cfg.verdicts:
        return f"verdict_{str(caption.verdict).lower()}"
    if values is not None and values.values_contradicted:
        return "contradicted"
    coc = caption.en if language == "en" else caption.zh
    if coc is None or language not in caption.prompt:
        return f"no_{language}"
    answer = dump_json(coc.ordered(cfg.decision))
    parsed = parse_answer(answer, language)
    if parsed.coc is None:  # the evaluation would call it wrong
        return f"answer_{parsed.reason}"
    pictures = Pictures(cfg.modalities, caption.picture_px, depth_range_m=caption.depth_range_m or DEPTH_RANGE_M)
    is_noisy = caption.label_from == "perturbed"  # and so are the decisions that this future rules out
    ruled_out = caption.checks.contradicted
    return Sample(
        sample_id=sample_id or caption.sample_id,
        language=language,
        run=run,
        window_id=caption.sample_id,
        town=caption.town,
        trajectory=caption.trajectory,
        variant=caption.variant,
        walk=walk,
        window=tuple(caption.window),
        views=pictures.views,
        picture_px=pictures.size_px,
        depth_range_m=pictures.depth_range_m,
        prompt=caption.prompt[language].told(pictures.sentence(language), measured=cfg.text_state),
        answer=answer,
        decision=parsed.coc.flight_decision,
        label=None if is_noisy else caption.label,
        contradicted=None if is_noisy or ruled_out is None else tuple(ruled_out),
    )


@dataclass(frozen=True)
class _CaptionedTrack:
    """What is known of the track of captions. name: unique among all runs. frames: that have all files of the views.

    size_px: (width, height); None if the tree does not have the track. key: `run/town/trajectory`.
    """

    key: str
    name: str | None
    size_px: tuple[int, int] | None
    frames: frozenset[int]


class _Window(NamedTuple):
    """The samples of one caption in all languages, and the reasons for missing ones."""

    track: _CaptionedTrack
    samples: list[Sample]
    reasons: list[str]


class _Windows:
    """The windows of all sources; can be iterated repeatedly.

    courses: of the tracks that were read. walks: key of a track -> its walk, set after the first iteration.
    """

    def __init__(self, cfg: PrepareConfig, sources: Sequence[RunSource]) -> None:
        self._cfg, self._sources = cfg, sources
        self._tracks: dict[tuple[str, Path], _CaptionedTrack] = {}
        self.courses: list[Course] = []
        self._read = lru_cache(maxsize=4)(lambda folder: read_track(folder, strict=False))
        places = [
            TrackPlace(source.run, *folder.relative_to(source.data).parts[-3:])
            for source in (sources if len(sources) > 1 else ())
            for folder in find_tracks(source.data)
        ]
        self._ids = flight_ids(places)
        self.walks: Mapping[str, str] = {}

    def __iter__(self) -> Iterator[_Window]:
        for source in self._sources:
            for caption in read_captions(source.captions):
                yield self._window(source, caption)

    def _window(self, source: RunSource, caption: Caption) -> _Window:
        names = (caption.town, caption.trajectory, caption.variant)
        folder = inside(source.data, "/".join(names), in_parent=True)
        if (source.run, folder) not in self._tracks:
            self._tracks[source.run, folder] = self._track(source, folder, names)
        track = self._tracks[source.run, folder]
        window = _Window(track, [], [])
        own: dict[str, Any] = {"run": source.run, "walk": self.walks.get(track.key, "")}
        if track.name is not None:
            own["sample_id"] = sample_id(track.name, caption.frame_index)
        for language in self._cfg.languages:
            sample = make_sample(caption, language, self._cfg, **own)
            if isinstance(sample, Sample):
                sample = _unfit(track, sample) or sample
            if isinstance(sample, Sample):
                past = _past_of(self._read(folder), sample.window)
                window.samples.append(sample.model_copy(update={"past": past}))
            else:
                window.reasons.append(sample)
        return window

    def _track(self, source: RunSource, folder: Path, names: tuple[str, str, str]) -> _CaptionedTrack:
        key, size_px, frames = f"{source.run}/{names[0]}/{names[1]}", None, frozenset[int]()
        if (folder / "trajectory.json").exists():
            track = self._read(folder)
            self.courses.append(Course(key, names[0], track.time_s, track.walked_m).at_seconds())
            size_px = (track.camera.width_px, track.camera.height_px)
            frames = frozenset(
                index
                for index in range(len(track))
                if all(frame_path(folder / frame_name(index), VIEW_FILES[v]).is_file() for v in self._cfg.modalities)
            )
        return _CaptionedTrack(key, self._ids.get(TrackPlace(source.run, *names)), size_px, frames)


def _past_of(track: Track, window: Sequence[int]) -> tuple[float, ...]:
    """Return the geometry of the last frames, for the baselines without pictures."""
    is_ordered = track.mission is not None and track.mission.order_at(window[-1]) is not None
    return tuple(past_of(track, window, is_ordered).round(DIGITS).tolist())


def _unfit(track: _CaptionedTrack, sample: Sample) -> str | None:
    """Return why the frames of a track are not those of a sample; None if they are."""
    if track.size_px is None or not track.frames.issuperset(sample.window):
        return "missing_image"
    fits = not sample.views or scaled_size(*track.size_px, max(sample.picture_px)) == sample.picture_px
    return None if fits else "picture_of_another_size"


# --- the stage --------------------------------------------------------------------------------------------------------


def run(
    cfg: PrepareConfig, sources: Sequence[RunSource], out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read the captions and playback trees of some runs; write a training set (distill/schema.py) into `out`.

    Returns:
        `out`.

    Raises:
        NothingKept: no caption can be used. VerifyError: captions are of another tree.
    """
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs_of(sources), seed=seed, resume=resume)
    if stage.is_complete:
        return out
    check_names([source.run for source in sources])
    for source in sources:
        record = record_of(source.captions)
        if record is None or "data" not in record.inputs:
            log.warning("%s: no record tells that these are captions of %s", source.captions, source.data)
    windows = _Windows(cfg, sources)
    # Two passes: the splits and the selection must be known before the first sample is written.
    ranks, keys, left_out = _survey(windows, seed)
    if not ranks:
        tally = Tally(input=left_out.total(), dropped=left_out)
        raise stage.nothing_kept(tally, expected="accepted captions with images below --data")
    windows.walks = walks_of(windows.courses)
    split_of = cfg.assigned(keys, windows.walks, seed)
    last_rank = sorted(ranks)[cfg.limit - 1] if 0 < cfg.limit < len(ranks) else max(ranks)
    decisions: dict[Split, Counter[str]] = {split: Counter() for split in SPLITS}
    tracks: dict[Split, set[tuple[str, ...]]] = {split: set() for split in SPLITS}
    with SplitWriter(out, Sample).writing() as writer:
        for sample in _selected(windows, last_rank, left_out, seed):
            split = split_of[f"{sample.run}/{sample.town}/{sample.trajectory}"]
            decisions[split][sample.decision] += 1
            tracks[split].add((sample.walk, sample.run, sample.town, sample.trajectory, sample.variant))
            writer.add(split, sample)
    pictured = sources if cfg.modalities else []
    trees = [SourceTree(run=source.run, sha256=fingerprint(source.data)) for source in pictured]
    write_model(out / RECORD, TrainingSet(split_by=cfg.split_by, trees=trees, samples=writer.counts), RECORD_FORMAT)
    page = write_page(out, "Training set", writer.counts, trees, PAGE_TEXT.format(cfg.split_by))
    num_kept = sum(writer.counts.values())
    tally = Tally(input=num_kept + left_out.total(), kept=num_kept, dropped=left_out)
    stage.finish([*writer.paths, out / RECORD, page], tally, splits=_facts(decisions, tracks), split_by=cfg.split_by)
    return out


def _rank(window: _Window, seed: int) -> int:
    """Return a random number of a window with samples, which does not depend on the other windows."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{STAGE}/{window.samples[0].sample_id}".encode()).digest()[:8])


def _survey(windows: _Windows, seed: int) -> tuple[set[int], set[str], Counter[str]]:
    """Return the ranks of the usable windows, the keys of their tracks, and the reasons for missing samples.

    Raises:
        InputError: two captions are of one window.
    """
    ranks, keys, reasons = set[int](), set[str](), Counter[str]()
    with progress_bar(f"{STAGE}: reading", total=None) as advance:
        for window in windows:
            advance(1)
            reasons.update(window.reasons)
            if window.samples:
                rank = _rank(window, seed)
                if rank in ranks:
                    where, fix = window.samples[0].sample_id, "remove one of the two lines from the captions"
                    raise InputError("two captions are of the same window", where=where, fix=fix)
                ranks.add(rank)
                keys.add(window.track.key)
    return ranks, keys, reasons


def _selected(windows: _Windows, last_rank: int, left_out: Counter[str], seed: int) -> Iterator[Sample]:
    """Yield the samples of the windows up to a rank; count the others in `left_out`."""
    with progress_bar(f"{STAGE}: writing", total=None) as advance:
        for window in windows:
            advance(1)
            if window.samples and _rank(window, seed) > last_rank:
                left_out["limit"] += len(window.samples)
            else:
                yield from window.samples


def _facts(
    decisions: Mapping[Split, Counter[str]], tracks: Mapping[Split, set[tuple[str, ...]]]
) -> dict[str, dict[str, Any]]:
    """Return the counts of the manifest; warn of empty splits and of decisions that training does not have."""
    facts: dict[str, dict[str, Any]] = {}
    for split, own in decisions.items():
        if not own:
            log.warning("%s: the split %s is empty", STAGE, split)
        if unseen := {name: count for name, count in own.items() if name not in decisions["train"]}:
            log.warning("%s: %s has decisions that train does not have: %s", STAGE, split, unseen)
        counts = {
            "samples": own.total(),
            "walks": len({walk for walk, *_ in tracks[split]}),
            "tracks": len(tracks[split]),
        }
        facts[split] = {**counts, "by_decision": dict(sorted(own.items())), "not_in_train": unseen}
    return facts
