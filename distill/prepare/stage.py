"""Captions to a training set: one sample per window and language, in splits that share no pedestrian trajectory.

Needs no torch. Pictures are not copied: a sample names frames of a playback tree. Its prompt is that of the caption,
with the sentence about the pictures that the student gets.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from cosfly.formats.captions import Caption, Language, Place, Verdict, read_captions
from cosfly.formats.frames import frame_name, frame_path
from cosfly.formats.places import Place as TrackPlace
from cosfly.formats.places import flight_ids, folder_name, sample_id
from cosfly.formats.places import place_of as track_place
from cosfly.formats.playback_file import read_track
from cosfly.formats.predictions import Split
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.splits import SPLITS, Course, assign_splits, town_family, walks_of
from cosfly.inspection.blind_baseline import past_of
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.config import Config, Distinct
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import check_stays_below, inside
from cosfly.runtime.json_io import dump_json, write_model
from cosfly.runtime.run_dir import StageFolder, Tally, fingerprint, record_of
from cosfly.viz.frame_views import DEPTH_RANGE_M, VIEW_FILES, Pictures, View, scaled_size
from distill.schema import RECORD, RECORD_FORMAT, Sample, SourceTree, TrainingSet, tree_inputs, write_page, write_splits

log = logging.getLogger(__name__)

STAGE = "distill.prepare"
DIGITS = 4  # of a past: a tenth of a millimetre, as trees have it
PAGE_TEXT = "`prompt` is the question, `answer` the expected answer. No two splits share a {}."


@dataclass(frozen=True)
class RunSource:
    """The part of one run: its playback tree and captions."""

    data: Path
    captions: Path

    @property
    def run(self) -> str:
        return run_of(self.data)

    @classmethod
    def of_run(cls, folder: Path) -> RunSource:
        """Return the source of a run directory, the output of `cosfly run`."""
        if not (folder / "render").is_dir():
            what = "the folder is not a run directory"
            fix = "pass the run that a release was built from, or --data and --captions for other folders"
            raise InputError(what, where=folder, expected="the folders render/ and caption/", fix=fix)
        captions = folder / "caption/captions.jsonl"
        check_stays_below(captions, captions.parent)
        return cls(folder / "render", captions)


def run_of(tree: Path) -> str:
    """Return the name of the run of a playback tree: that of the folder that contains it."""
    return folder_name(tree.absolute().parent.name)


def check_names(runs: Sequence[str]) -> None:
    """Check that no two runs have the same name."""
    if len(set(runs)) < len(runs):
        fix = "rename the folder that contains one of the trees"
        raise InputError("two runs have the same name", got=", ".join(runs), fix=fix)


class SplitConfig(Config):
    """What splits must not share, and how large they are."""

    split_by: Literal["walk", "town"] = Field(
        "walk", description="what two splits must not share: a pedestrian trajectory (walk), or a town"
    )
    val_fraction: float = Field(
        0.1, ge=0, lt=1, description="share of pedestrian trajectories (or towns) for validation; 0: none"
    )
    test_fraction: float = Field(
        0.1, ge=0, lt=1, description="share of pedestrian trajectories (or towns) for the test; 0: none"
    )

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> SplitConfig:
        if self.val_fraction + self.test_fraction >= 1.0:
            raise ValueError("val_fraction + test_fraction must be below 1, so that samples are left for training")
        return self

    def assigned(self, keys: Collection[str], walks: Mapping[str, str], seed: int) -> dict[str, Split]:
        """Return the split of each track's key, `run/town/trajectory`: all keys of a walk (key -> walk), or of a town,
        share it. With fewer walks (or towns) than splits, train is filled first, then val."""
        if self.split_by == "town":
            group_of = {key: town_family(key.split("/")[1]) for key in keys}
        else:
            group_of = {key: walks[key] for key in keys}
        fractions: dict[Split, float] = {"val": self.val_fraction, "test": self.test_fraction}
        split_of = assign_splits(group_of.values(), fractions, seed)
        return {key: split_of[group] for key, group in group_of.items()}


class PrepareConfig(SplitConfig):
    """Settings of `distill prepare`."""

    languages: Distinct[tuple[Language, ...]] = Field(
        ("en", "zh"), min_length=1, description="languages of the answers; each gives its own samples"
    )
    decision: Place = Field(
        "first", description="place of the decision among the fields of an answer; a student answers in this order"
    )
    modalities: Distinct[tuple[View, ...]] = Field(
        ("rgb",), description="pictures of each frame, in this order; middle: the middle third of rgb; empty: only text"
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
        return self


# --- samples ----------------------------------------------------------------------------------------------------------


def make_sample(
    caption: Caption, language: Language, cfg: PrepareConfig, *, run: str = "", sample_id: str = ""
) -> Sample | str:
    """Return the sample of a caption in one language, or the reason why there is none; its walk is not known yet. The
    id must be unique among the samples of all runs; "" takes that of the caption."""
    if caption.status != "accepted":
        return f"dropped_{caption.drop_reason or 'unknown'}"
    if caption.verdict not in cfg.verdicts:
        return f"verdict_{str(caption.verdict).lower()}"
    values = (caption.checks.values or {}).get(language)
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
    is_noisy = caption.label_from == "perturbed"  # the label, and the decisions that are ruled out
    ruled_out = caption.checks.contradicted
    return Sample(
        **{name: getattr(caption, name) for name in ("town", "trajectory", "variant")},
        sample_id=sample_id or caption.sample_id, language=language, run=run, window_id=caption.sample_id, walk="",
        window=tuple(caption.window), views=pictures.views, picture_px=pictures.size_px,
        depth_range_m=pictures.depth_range_m,
        prompt=caption.prompt[language].filled(pictures.sentence(language), measured=cfg.text_state), answer=answer,
        decision=parsed.coc.flight_decision, label=None if is_noisy else caption.label,
        contradicted=None if is_noisy or ruled_out is None else tuple(ruled_out),
    )  # fmt: skip


def track_key(of: TrackPlace | Sample) -> str:
    """Return the name of a track and of its other variants."""
    return f"{of.run}/{of.town}/{of.trajectory}"


class _Tracks:
    """The tracks of all sources."""

    def __init__(self, cfg: PrepareConfig, sources: Sequence[RunSource]) -> None:
        self._cfg = cfg
        self._sources = sources
        self._frames: dict[Path, frozenset[int]] = {}  # of each track: those that have all files of the views
        self.courses: list[Course] = []  # of the pedestrians of the tracks that were read
        self._read = lru_cache(maxsize=4)(lambda folder: read_track(folder))
        self._ids: dict[TrackPlace, str] = {}  # begin of the sample ids; empty for one source, which keeps its ids
        if len(sources) > 1:
            places = [track_place(folder, source.run) for source in sources for folder in find_tracks(source.data)]
            self._ids = flight_ids(places)

    def windows(self) -> Iterator[list[Sample | str]]:
        """Yield the samples of each caption, one per language, with a reason in place of a missing one."""
        for source in self._sources:
            for caption in read_captions(source.captions):
                yield [self._sample(source, caption, language) for language in self._cfg.languages]

    def _sample(self, source: RunSource, caption: Caption, language: Language) -> Sample | str:
        """Return the sample of a caption with the past of its track, or the reason why there is none."""
        place = TrackPlace(source.run, caption.town, caption.trajectory, caption.variant)
        folder = inside(source.data, f"{place.town}/{place.trajectory}/{place.variant}", in_parent=True)
        if folder not in self._frames:
            self._frames[folder] = self._frames_of(folder, place)
        name = sample_id(self._ids[place], caption.frame_index) if place in self._ids else caption.sample_id
        sample = make_sample(caption, language, self._cfg, run=source.run, sample_id=name)
        if isinstance(sample, str):
            return sample
        if not self._frames[folder].issuperset(sample.window):
            return "missing_image"
        track = self._read(folder)
        size_px = scaled_size(track.camera.width_px, track.camera.height_px, max(sample.picture_px))
        if sample.views and size_px != sample.picture_px:
            return "picture_of_another_size"
        is_ordered = track.mission is not None and track.mission.order_at(sample.window[-1]) is not None
        past = past_of(track, sample.window, is_ordered).round(DIGITS)  # for the baselines without pictures
        return sample.model_copy(update={"past": tuple(past.tolist())})

    def _frames_of(self, folder: Path, place: TrackPlace) -> frozenset[int]:
        """Return the frames of a track that have all files of the views, and note its course."""
        if not (folder / "trajectory.json").exists():
            return frozenset()
        track = self._read(folder)
        self.courses.append(Course(track_key(place), place.town, track.time_s, track.walked_m).at_seconds())
        names = [VIEW_FILES[view] for view in self._cfg.modalities]
        return frozenset(
            i for i in range(len(track)) if all(frame_path(folder / frame_name(i), name).is_file() for name in names)
        )


# --- the stage --------------------------------------------------------------------------------------------------------


def run(cfg: PrepareConfig, sources: Sequence[RunSource], out: Path, *, seed: int = 0) -> Path:
    """Read the captions and playback trees of some runs; write a training set (distill/schema.py) into `out`, which is
    returned. NothingKept: no caption can be used. VerifyError: captions are of another tree."""
    inputs = tree_inputs([source.data for source in sources], [source.captions for source in sources])
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed)
    if stage.is_complete:
        return out
    check_names([source.run for source in sources])
    for source in sources:
        record = record_of(source.captions)
        if record is None or "data" not in record.inputs:
            log.warning("%s: no record tells that these are captions of %s", source.captions, source.data)
    tracks = _Tracks(cfg, sources)
    windows, dropped = _read_windows(tracks)
    if not windows:
        tally = Tally(input=dropped.total(), dropped=dropped)
        raise stage.nothing_kept(tally, expected="accepted captions with images below --data")
    walks = walks_of(tracks.courses)
    split_of = cfg.assigned({track_key(of_window[0]) for of_window in windows.values()}, walks, seed)
    # Windows are chosen by a hash, so that a choice does not depend on the other windows.
    ranked = sorted(windows, key=lambda name: hashlib.sha256(f"{seed}/{STAGE}/{name}".encode()).digest())
    chosen = set(ranked[: cfg.limit or None])
    samples: dict[Split, list[Sample]] = {split: [] for split in SPLITS}
    for name, of_window in windows.items():
        key = track_key(of_window[0])
        if name in chosen:
            samples[split_of[key]] += [sample.model_copy(update={"walk": walks[key]}) for sample in of_window]
        else:
            dropped["limit"] += len(of_window)
    counts, paths = write_splits(out, Sample, samples)
    trees: list[SourceTree] = []
    if cfg.modalities:
        trees = [SourceTree(run=source.run, sha256=fingerprint(source.data)) for source in sources]
    write_model(out / RECORD, TrainingSet(split_by=cfg.split_by, trees=trees, samples=counts), RECORD_FORMAT)
    page = write_page(out, "Training set", counts, trees, PAGE_TEXT.format(cfg.split_by))
    num_kept = sum(counts.values())
    tally = Tally(input=num_kept + dropped.total(), kept=num_kept, dropped=dropped)
    stage.finish([*paths, out / RECORD, page], tally, splits=_facts(samples), split_by=cfg.split_by)
    return out


def _read_windows(tracks: _Tracks) -> tuple[dict[str, list[Sample]], Counter[str]]:
    """Return the samples of each window by their id, and why how many are dropped."""
    windows = dict[str, list[Sample]]()
    dropped = Counter[str]()
    with progress_bar(f"{STAGE}: reading", total=None) as advance:
        for results in tracks.windows():
            advance(1)
            dropped.update(reason for reason in results if isinstance(reason, str))
            samples = [sample for sample in results if isinstance(sample, Sample)]
            if not samples:
                continue
            name = samples[0].sample_id
            if name in windows:
                fix = "remove one of the two lines"
                raise InputError("the captions have two lines for this window", where=name, fix=fix)
            windows[name] = samples
    return windows, dropped


def _facts(samples: Mapping[Split, Sequence[Sample]]) -> dict[str, dict[str, Any]]:
    """Return the counts of the manifest, and log them; warn of decisions that training does not have."""
    facts: dict[str, dict[str, Any]] = {}
    in_train = {sample.decision for sample in samples["train"]}
    for split, in_split in samples.items():
        decisions = dict(sorted(Counter(sample.decision for sample in in_split).items()))
        if not_in_train := {name: count for name, count in decisions.items() if name not in in_train}:
            log.warning("%s: %s has decisions that train does not have: %s", STAGE, split, not_in_train)
        walks = {sample.walk for sample in in_split}
        tracks = {(sample.run, sample.town, sample.trajectory, sample.variant) for sample in in_split}
        counts = {"samples": len(in_split), "walks": len(walks), "tracks": len(tracks)}
        words = "%s: %s (samples: %d, pedestrian trajectories: %d)"
        log.log(logging.INFO if in_split else logging.WARNING, words, STAGE, split, len(in_split), len(walks))
        facts[split] = {**counts, "by_decision": decisions, "not_in_train": not_in_train}
    return facts
