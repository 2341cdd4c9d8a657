"""Captions to a training set: one sample per window and language, in splits that share no walk.

Needs no torch. Images are not copied: a sample names frames of a playback tree relative to its root. Its prompt is that
of the caption with the sentence about the pictures made anew, for those that the student gets. Memory grows by the
flights, and by some bytes a window.
"""

from __future__ import annotations

import hashlib
import logging
import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from cosfly.formats.captions import PICTURES_MARK, TOKENS, Caption, Language, Place, Verdict, not_in_set, read_captions
from cosfly.formats.places import TrackChoice
from cosfly.formats.playback import read_track
from cosfly.formats.predictions import Split
from cosfly.geometry.splits import SPLITS
from cosfly.inspection.blind_baseline import past_of
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.run_dir import Resume, StageFolder, Tally, fingerprint
from cosfly.viz.frame_views import DEPTH_RANGE_M, Pictures, View, scaled_size
from distill.prepare.sources import CaptionedFlight, Flights, RunSource, check_sources, inputs_of
from distill.prepare.splitting import SplitConfig, check_no_leak
from distill.schema import Sample, SourceTree, TrainingSetWriter, open_split


def _rank(sample_id: str, seed: int) -> int:
    return int.from_bytes(hashlib.sha256(f"{seed}/distill.balance/{sample_id}".encode()).digest()[:8])


def keeps(last_rank: Mapping[str, int], seed: int, decision: str, sample_id: str) -> bool:
    """Return whether a window stays; last_rank: decision -> rank of the last window that does, none where all do."""
    return decision not in last_rank or _rank(sample_id, seed) <= last_rank[decision]


class WindowRanks:
    """The 64-bit ranks of the windows by flight and decision, which is all that is held of them.

    Twelve bytes a window in two long arrays, not a short one for each flight and decision: the system takes long ones
    back.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._kinds: dict[tuple[str, str], int] = {}  # flight and decision -> their number
        self._kind_of, self._ranks = array("I"), array("Q")  # of each window

    @property
    def flights(self) -> list[str]:
        return list(dict.fromkeys(flight for flight, _ in self._kinds))

    def add(self, flight: str, decision: str, sample_id: str) -> None:
        self._kind_of.append(self._kinds.setdefault((flight, decision), len(self._kinds)))
        self._ranks.append(_rank(sample_id, self.seed))

    def by_kind(self) -> Iterator[tuple[str, str, np.ndarray]]:
        """Yield each flight and decision with the ranks of its windows; needs a window."""
        kind_of, ranks = np.frombuffer(self._kind_of, np.uint32), np.frombuffer(self._ranks, np.uint64)
        parts = np.split(ranks[np.argsort(kind_of, kind="stable")], np.cumsum(np.bincount(kind_of))[:-1])
        return ((*kind, part) for kind, part in zip(self._kinds, parts, strict=True))


def _last(ranks: list[np.ndarray], count: int) -> int:
    """Return the rank of the window that is the last of so many; -1 for none."""
    return int(np.partition(np.concatenate(ranks), count - 1)[count - 1]) if count else -1


@dataclass(frozen=True)
class Balance:
    """What stays of the training split. most_windows: of a decision. windows: decision -> how many there were.

    last_rank: decision that has too many -> rank of the last window that stays.
    """

    most_windows: int
    windows: Mapping[str, int]
    last_rank: Mapping[str, int]

    def cost(self, samples_left_out: int) -> dict[str, Any]:
        """Return `balance` of the manifest. effective_decisions: as many equally frequent ones have the same
        entropy."""
        after = {decision: min(count, self.most_windows) for decision, count in self.windows.items()}
        return {
            "most_windows": self.most_windows,
            "windows": dict(self.windows),
            "windows_left_out": {name: n - after[name] for name, n in self.windows.items() if n > after[name]},
            "samples_left_out": samples_left_out,
            "effective_decisions": [_effective(self.windows), _effective(after)],
            "absent": [action for action in TOKENS if action not in self.windows],
        }


def balance_of(ranks: WindowRanks, train: Collection[str]) -> Balance:
    """Keep of each decision at most an equal share of the windows, and at least one.

    An equal share is the windows over the decisions that occur. The median or the least of the counts would be no
    measure: a few stray decisions of one or two windows bring them down, and nearly all of the others with them.

    Args:
        train: flights of the training split, at least one.
    """
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for flight, decision, own in ranks.by_kind():
        if flight in train:
            found[decision].append(own)
    windows = {decision: sum(map(len, own)) for decision, own in sorted(found.items())}
    most = max(1, sum(windows.values()) // len(windows))
    last_rank = {decision: _last(own, most) for decision, own in found.items() if windows[decision] > most}
    return Balance(most, windows, last_rank)


def limit_to(
    ranks: WindowRanks, num_windows: int, train: Collection[str], balance: Balance | None
) -> Mapping[str, int] | None:
    """Choose exactly so many windows, of each decision its share, rounded by largest remainders.

    Args:
        train: flights of the training split, of which `balance` has left out what it does.
    Returns:
        decision -> rank of the last window that stays, -1 where none does; None where there are no more anyway.
    """
    left: dict[str, list[np.ndarray]] = defaultdict(list)
    for flight, decision, own in ranks.by_kind():
        last = balance.last_rank.get(decision) if balance is not None and flight in train else None
        left[decision].append(own if last is None else own[own <= np.uint64(last)])
    counts = {decision: sum(map(len, own)) for decision, own in left.items()}
    total = sum(counts.values())
    if num_windows >= total:
        return None
    wanted = {decision: num_windows * count // total for decision, count in counts.items()}
    by_remainder = sorted(counts, key=lambda name: (-(num_windows * counts[name] % total), _rank(name, ranks.seed)))
    for decision in by_remainder[: num_windows - sum(wanted.values())]:
        wanted[decision] += 1
    return {decision: _last(own, wanted[decision]) for decision, own in left.items()}


def _effective(counts: Mapping[str, int]) -> float:
    """Return the effective number of kinds, the exponential of Shannon's entropy (Hill 1973, order 1)."""
    total = sum(counts.values())
    return round(math.exp(-sum(count / total * math.log(count / total) for count in counts.values())), 2)


log = logging.getLogger(__name__)

STAGE = "distill.prepare"
DIGITS = 4  # of a past: a tenth of a millimetre, as trees have it


class PrepareConfig(SplitConfig):
    """Settings of `distill prepare`."""

    flights: TrackChoice = Field(TrackChoice(), description="tracks to use")
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
    unbound: Literal["refuse", "accept"] = Field(
        "refuse",
        description="captions whose playback tree is not recorded, such as a copied file",
    )
    repaired: Literal["keep", "exclude"] = Field("keep", description="treatment of regenerated captions")
    verdicts: tuple[Verdict, ...] = Field(
        ("CONSISTENT", "SOFT_CONFLICT", "ABSTAIN"), min_length=1, description="verdicts of the captions to use"
    )
    contradicted: Literal["keep", "exclude"] = Field(
        "exclude", description="treatment of answers with a value that contradicts the measured facts"
    )
    balance: Literal["none", "decisions"] = Field(
        "none", description="decisions: drop training windows of a decision beyond an equal share"
    )
    limit: int = Field(0, ge=0, description="number of windows in all splits, with the share of each decision; 0: all")

    @model_validator(mode="after")
    def _there_is_something_to_learn(self) -> PrepareConfig:
        if not self.modalities and not self.text_state:
            raise ValueError("modalities must not be empty if text_state is false")
        if len(set(self.languages)) < len(self.languages) or len(set(self.modalities)) < len(self.modalities):
            raise ValueError("languages and modalities must not repeat an entry")
        return self


def make_sample(
    caption: Caption,
    language: Language,
    cfg: PrepareConfig,
    *,
    run: str = "",
    walk: str = "",
    sample_id: str = "",
) -> Sample | str:
    """Return the sample of a caption in one language, or the word for why there is none.

    Args:
        run, walk: of its flight. sample_id: unique among the samples of all runs; "" takes the caption's.
    """
    if reason := _reason_to_leave_out(caption, language, cfg):
        return reason
    coc = caption.en if language == "en" else caption.zh
    if coc is None or language not in caption.prompt:
        return f"no_{language}"
    answer = dump_json(coc.ordered(cfg.decision))
    parsed = parse_answer(answer, language)
    if parsed.coc is None:  # nothing may be taught that evaluation would call wrong
        return f"answer_{parsed.reason}"
    if PICTURES_MARK not in caption.prompt[language].user:
        where, expected = f"{caption.sample_id}: prompt.{language}", f"{PICTURES_MARK} in the prompt"
        what, fix = "the prompt has no mark for the pictures", "run cosfly caption again"
        raise InputError(what, where=where, expected=expected, fix=fix)
    pictures = Pictures(cfg.modalities, caption.picture_px, depth_range_m=caption.depth_range_m or DEPTH_RANGE_M)
    values = (caption.checks.values or {}).get(language)
    is_noisy = caption.label_from == "perturbed"  # and so is what that future rules out
    place = {"town": caption.town, "trajectory": caption.trajectory, "variant": caption.variant, "walk": walk}
    return Sample(
        sample_id=sample_id or caption.sample_id,
        language=language,
        run=run,
        window_id=caption.sample_id,
        **place,
        window=tuple(caption.window),
        views=pictures.views,
        picture_px=pictures.size_px,
        depth_range_m=pictures.depth_range_m,
        prompt=caption.prompt[language].told(pictures.sentence(language), measured=cfg.text_state),
        answer=answer,
        decision=parsed.coc.flight_decision,
        label=None if is_noisy else caption.label,
        contradicted=None if is_noisy or (ruled_out := caption.checks.contradicted) is None else tuple(ruled_out),
        repair=None if caption.repair is None else caption.repair.rung or caption.repair.strategy,
        values_contradicted=None if values is None else values.values_contradicted,
        weight=1.0,
    )


def _reason_to_leave_out(caption: Caption, language: Language, cfg: PrepareConfig) -> str | None:
    """Return the word for why the settings leave a caption out, by its record alone; None: they take it."""
    if caption.status != "accepted":
        return f"dropped_{caption.drop_reason or 'unknown'}"
    if caption.repair is not None and cfg.repaired == "exclude":
        return "repaired"
    if caption.verdict not in cfg.verdicts:
        return f"verdict_{str(caption.verdict).lower()}"
    values = (caption.checks.values or {}).get(language)
    if cfg.contradicted == "exclude" and values is not None and values.values_contradicted:
        return "contradicted"
    return None


@dataclass(frozen=True)
class _Window:
    """What the languages of one caption give: samples, and the reasons for leaving others out."""

    flight: CaptionedFlight
    sample_id: str
    samples: list[Sample]
    left_out: list[str]

    @property
    def decision(self) -> str:
        """That of the first language, should they differ."""
        return self.samples[0].decision


class _Windows:
    """All windows of all sources, as often as they are asked for."""

    def __init__(self, cfg: PrepareConfig, sources: Sequence[RunSource]) -> None:
        self._cfg, self._sources = cfg, sources
        self.flights = Flights(sources)
        self._frames_of = lru_cache(maxsize=16)(lambda flight: flight.whole_frames(cfg.modalities))
        self._read = lru_cache(maxsize=16)(lambda flight: read_track(flight.folder, strict=False))
        self._is_chosen = lru_cache(maxsize=16)(lambda flight: flight.is_chosen(cfg.flights))
        self.walks: Mapping[str, str] = {}
        self.count = 0

    def __iter__(self) -> Iterator[_Window]:
        for source in self._sources:
            for caption in read_captions(source.captions):
                yield self._window(source, caption)

    def _window(self, source: RunSource, caption: Caption) -> _Window:
        flight = self.flights.of(source, caption)
        if caption.en is not None and caption.en.flight_decision not in TOKENS:
            raise not_in_set(caption.en.flight_decision, f"{source.captions}: {caption.sample_id}")
        caption.town = flight.town  # the tree may have been converted since
        window = _Window(flight, flight.sample_id(caption), [], [])
        if not self._is_chosen(flight):
            window.left_out.extend(["not_chosen"] * len(self._cfg.languages))
            return window
        walk = self.walks.get(flight.key, "")
        for language in self._cfg.languages:
            named = {"run": source.run, "walk": walk, "sample_id": window.sample_id}
            sample = make_sample(caption, language, self._cfg, **named)
            if isinstance(sample, str):
                window.left_out.append(sample)
            elif reason := self._unfit(flight, sample):
                window.left_out.append(reason)
            else:
                window.samples.append(sample.model_copy(update={"past": self._past_of(flight, caption)}))
        return window

    def _past_of(self, flight: CaptionedFlight, caption: Caption) -> tuple[float, ...]:
        """Return the geometry of the last frames, for the baselines without pictures."""
        track = self._read(flight)
        is_ordered = track.mission is not None and track.mission.order_at(caption.window[-1]) is not None
        return tuple(past_of(track, caption.window, is_ordered).round(DIGITS).tolist())

    def _unfit(self, flight: CaptionedFlight, sample: Sample) -> str | None:
        """Return why the frames of a flight are not those that a sample speaks of."""
        if not self._frames_of(flight).issuperset(sample.window):
            return "missing_image"
        assert flight.size_px is not None, "frames of a flight that nobody read"
        fits = not sample.views or scaled_size(*flight.size_px, max(sample.picture_px)) == sample.picture_px
        return None if fits else "picture_of_another_size"


@dataclass(frozen=True)
class _Selection:
    """What goes where: walks (or towns) to splits, and which windows stay."""

    split_of: Mapping[str, Split]  # by key of the flight
    num_groups: Counter[Split]  # walks (or towns) of each split
    balance: Balance | None
    limit: Mapping[str, int] | None
    seed: int

    def left_out(self, window: _Window) -> str | None:
        """Return the reason for which a window is left out of its split."""
        balance = self.balance if self.split_of[window.flight.key] == "train" else None
        if balance is not None and not keeps(balance.last_rank, self.seed, window.decision, window.sample_id):
            return "balance"
        return None if keeps(self.limit or {}, self.seed, window.decision, window.sample_id) else "limit"


def run(
    cfg: PrepareConfig, sources: Sequence[RunSource], out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read the captions and playback trees of some runs; write a training set (distill/schema.py) into `out`.

    Returns:
        `out`, the training set.
    Raises:
        NothingKept: no caption can be used. InputError: there are too few walks to split. VerifyError: captions are of
            another tree.
    """
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs_of(sources), seed=seed, resume=resume)
    if stage.is_complete:
        return out
    check_sources(sources, cfg.unbound)
    windows = _Windows(cfg, sources)
    # Two passes: the splits, and what is too much, must be known before the first sample is written.
    ranks, excluded = _survey(windows, seed)
    if not ranks.flights:
        tally = Tally(input=excluded.total(), dropped=excluded)
        raise stage.nothing_kept(tally, expected="accepted captions with images below --data")
    chosen = _choose(cfg, windows, ranks, seed)
    del ranks  # of a million windows they take as much as the writing
    with TrainingSetWriter(out).writing() as writer:
        facts, left_out = _write(windows, chosen, writer)
    writer.finish(cfg.split_by, [SourceTree(run=s.run, sha256=fingerprint(s.data)) for s in sources])
    counts = check_no_leak({split: open_split(out, split) for split in SPLITS}, cfg.split_by)
    excluded += left_out
    if chosen.balance is not None:
        facts["train"]["balance"] = cost = chosen.balance.cost(left_out["balance"])
        log.info("%s: balance of train: %s", STAGE, ", ".join(f"{name} {value}" for name, value in cost.items()))
    _warn(facts)
    tally = Tally(input=sum(counts.values()) + excluded.total(), kept=sum(counts.values()), dropped=excluded)
    stage.finish(writer.files, tally, splits=facts, split_by=cfg.split_by)
    return out


def _survey(windows: _Windows, seed: int) -> tuple[WindowRanks, Counter[str]]:
    """Go over all windows once: the ranks of those that can be used, and why samples are left out."""
    ranks, excluded = WindowRanks(seed), Counter[str]()
    with progress_bar(f"{STAGE}: reading", total=None) as advance:
        for window in windows:
            windows.count += 1
            excluded.update(window.left_out)
            if window.samples:
                ranks.add(f"{window.flight.key}/{window.flight.variant}", window.decision, window.sample_id)
            advance(1)
    return ranks, excluded


def _choose(cfg: PrepareConfig, windows: _Windows, ranks: WindowRanks, seed: int) -> _Selection:
    windows.walks = windows.flights.walks()
    keys = {flight: flight.rpartition("/")[0] for flight in ranks.flights}
    fix = "caption more trajectories, set a fraction to 0, or --set distill.prepare.too_few=fill"
    owners = cfg.assigned(set(keys.values()), windows.walks, seed, "usable captions", fix)
    split_of = {key: split for key, (_, split) in owners.items()}
    train = {flight for flight, key in keys.items() if split_of[key] == "train"}
    balance = balance_of(ranks, train) if cfg.balance == "decisions" else None
    limit = limit_to(ranks, cfg.limit, train, balance) if cfg.limit else None
    return _Selection(split_of, Counter(split for _, split in set(owners.values())), balance, limit, seed)


def _write(
    windows: _Windows, chosen: _Selection, writer: TrainingSetWriter
) -> tuple[dict[str, dict[str, Any]], Counter[str]]:
    """Write the samples.

    Returns:
        split -> counts of its samples, by language, by decision, repaired; reason -> samples that were not chosen.
    """
    names = ("language", "decision", "repair")
    counters: dict[Split, dict[str, Counter[str]]] = {split: {name: Counter() for name in names} for split in SPLITS}
    flights: dict[str, set[str]] = {split: set() for split in SPLITS}
    left_out = Counter[str]()
    with progress_bar(f"{STAGE}: writing", total=windows.count) as advance:
        for window in windows:
            advance(1)
            reason = chosen.left_out(window) if window.samples else None
            for sample in window.samples:
                if reason is not None:
                    left_out[reason] += 1
                    continue
                split = chosen.split_of[window.flight.key]
                writer.add_sample(split, sample)
                flights[split].add(f"{window.flight.key}/{window.flight.variant}")
                counter = counters[split]
                counter["language"][sample.language] += 1
                counter["decision"][sample.decision] += 1
                counter["repair"][sample.repair or "none"] += 1
    facts: dict[str, dict[str, Any]] = {
        split: {
            "samples": found["language"].total(),
            "groups": chosen.num_groups[split],
            "flights": len(flights[split]),
            **{f"by_{name}": dict(sorted(counter.items())) for name, counter in found.items()},
        }
        for split, found in counters.items()
    }
    return facts, left_out


def _warn(facts: Mapping[str, dict[str, Any]]) -> None:
    """Tell of splits that are empty, and of decisions that are asked for and never taught; both stand in the facts."""
    taught = facts["train"]["by_decision"]
    for split in SPLITS:
        if not facts[split]["samples"]:
            log.warning("%s: the split %s is empty", STAGE, split)
        unseen = {name: count for name, count in facts[split]["by_decision"].items() if name not in taught}
        facts[split]["not_in_train"] = unseen
        if unseen:
            log.warning("%s: %s has decisions that train does not have: %s", STAGE, split, unseen)
