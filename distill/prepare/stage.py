"""Captions to a training set: one sample per window and language, in splits that share no trajectory.

Needs no torch. Images are not copied: a sample names frames of the playback tree relative to its root. Its prompt is that of the
caption with the sentence about the pictures made anew, for those that the student gets.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from cosfly.config import Config
from cosfly.errors import InputError, VerifyError
from cosfly.frame_views import DEPTH_RANGE_M, Pictures, View
from cosfly.products.captions import PICTURES_MARK, Caption, Language, Verdict, parse_answer, read_captions
from cosfly.products.frames import frame_name
from cosfly.products.places import stand
from cosfly.provenance import warn_unbound
from cosfly.stage_folder import Resume, StageFolder, Tally
from cosfly.store import atomic_file, dump_json
from distill.prepare.balance import Cut, Ranks, cost_of
from distill.schema import SPLITS, Sample, Split, read_split, split_path

log = logging.getLogger(__name__)


class PrepareConfig(Config):
    """Settings of `distill prepare`."""

    languages: tuple[Language, ...] = Field(
        ("en", "zh"), min_length=1, description="answers to learn, each language as samples of its own"
    )
    modalities: tuple[View, ...] = Field(
        ("rgb",), min_length=1, description="pictures of each window frame, in this order: rgb, depth, segmentation"
    )
    split_by: Literal["trajectory", "town"] = Field(
        "trajectory",
        description="what may not be shared by two splits; both flights of a trajectory always stay together",
    )
    val_fraction: float = Field(0.1, ge=0, lt=1, description="share of trajectories (towns) for validation; 0: none")
    test_fraction: float = Field(0.1, ge=0, lt=1, description="share of trajectories (towns) for the test; 0: none")
    too_few: Literal["refuse", "fill"] = Field(
        "refuse",
        description="with fewer trajectories (towns) than splits: refuse, or fill train, then val, and leave the rest empty",
    )
    repaired: Literal["keep", "exclude"] = Field("keep", description="what happens to captions that a repair made")
    repaired_weight: float = Field(1.0, gt=0, le=1, description="weight of a repaired sample in the loss; 1: as any")
    verdicts: tuple[Verdict, ...] = Field(
        ("CONSISTENT", "SOFT_CONFLICT", "ABSTAIN"), min_length=1, description="captions of these verdicts are learnt"
    )
    contradicted: Literal["keep", "exclude"] = Field(
        "exclude", description="what happens to answers of which the geometry contradicts a sentence"
    )
    min_proved: float = Field(
        0.0,
        ge=0,
        le=1,
        description="least share of an answer's sentences that the geometry proves; 0 takes unread ones too",
    )
    weigh_proved: bool = Field(
        False,
        description="multiply a sample's weight by that share (half at least, so that what is unread still counts)",
    )
    balance: Literal["none", "decisions"] = Field(
        "none",
        description="decisions: training windows of a decision beyond `balance_ratio` are left out; validation and test stay",
    )
    balance_ratio: float = Field(
        1.0,
        gt=0,
        allow_inf_nan=False,
        description="most training windows of a decision, as a multiple of an equal share (windows / decisions that occur)",
    )

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> PrepareConfig:
        if self.val_fraction + self.test_fraction >= 1.0:
            raise ValueError("val_fraction + test_fraction must stay below 1, or nothing is left to train on")
        if len(set(self.languages)) < len(self.languages) or len(set(self.modalities)) < len(self.modalities):
            raise ValueError("languages and modalities may name each entry once")
        return self

    @property
    def wanted_splits(self) -> tuple[Split, ...]:
        fractions = {"train": 1.0, "val": self.val_fraction, "test": self.test_fraction}
        return tuple(name for name in SPLITS if fractions[name] > 0)


# --- splits -----------------------------------------------------------------------------------------------------------


def assign_splits(groups: Iterable[str], cfg: PrepareConfig, seed: int) -> dict[str, Split]:
    """Hand out groups to splits: group -> split.

    Groups are ranked by a hash of (seed, group); the first go to test, the next to val, the rest to train, in numbers as near
    to the fractions as a whole group allows and at least one for each split that has a share.

    Raises:
        InputError: fewer groups than splits, and `too_few` is refuse.
    """
    ranked = sorted(set(groups), key=lambda group: hashlib.sha256(f"{seed}/distill.split/{group}".encode()).digest())
    wanted = cfg.wanted_splits
    if len(ranked) < len(wanted):
        if cfg.too_few == "refuse" or not ranked:
            raise InputError(
                f"too few {cfg.split_by} groups with accepted captions to split without a leak",
                got=str(len(ranked)),
                expected=f"{len(wanted)} or more, one for each of {', '.join(wanted)}",
                fix="caption more flights, set a fraction to 0, or --set distill.prepare.too_few=fill",
            )
        return dict(zip(ranked, wanted, strict=False))
    num_test = max(1, round(cfg.test_fraction * len(ranked))) if cfg.test_fraction else 0
    num_val = max(1, round(cfg.val_fraction * len(ranked))) if cfg.val_fraction else 0
    while num_test + num_val >= len(ranked):  # rounding took all: the larger share gives one back
        num_test, num_val = (num_test - 1, num_val) if num_test >= num_val else (num_test, num_val - 1)
    counts: dict[Split, int] = {"test": num_test, "val": num_val, "train": len(ranked) - num_test - num_val}
    names = [split for split, count in counts.items() for _ in range(count)]
    return dict(zip(ranked, names, strict=True))


def check_no_leak(
    splits: Mapping[str, Iterable[Sample]], split_by: Literal["trajectory", "town"] = "trajectory"
) -> dict[str, int]:
    """Check that no trajectory, town (if asked), image or sample stands in two splits, and no sample twice in one.

    Returns:
        split -> number of samples.
    Raises:
        VerifyError: names what is shared and by which splits.
    """
    owners: dict[tuple[str, str], str] = {}
    seen: set[str] = set()
    counts: dict[str, int] = {}
    for split, samples in splits.items():
        counts[split] = 0
        for sample in samples:
            counts[split] += 1
            shared = [("trajectory", sample.group("trajectory")), *(("image", image) for image in sample.images)]
            if split_by == "town":
                shared.append(("town", sample.group("town")))
            for what, name in shared:
                owner = owners.setdefault((what, name), split)
                if owner != split:
                    raise VerifyError(
                        f"two splits share a {what}", where=sample.key, got=f"{name} in {owner} and in {split}"
                    )
            if sample.key in seen:
                raise VerifyError("a sample stands twice in the training set", where=split, got=sample.key)
            seen.add(sample.key)
    return counts


# --- samples ----------------------------------------------------------------------------------------------------------


def make_sample(caption: Caption, language: Language, cfg: PrepareConfig) -> Sample | str:
    """Give the sample of a caption in one language, or the word for why there is none.

    Raises:
        InputError: the prompt cannot say which pictures the student gets.
    """
    if caption.status != "accepted":
        return f"dropped_{caption.drop_reason or 'unknown'}"
    if caption.repair is not None and cfg.repaired == "exclude":
        return "repaired"
    if caption.verdict not in cfg.verdicts:
        return f"verdict_{str(caption.verdict).lower()}"
    states = (caption.checks.sentences or {}).get(language, [])
    if "contradicted" in states and cfg.contradicted == "exclude":
        return "contradicted"
    proved = caption.coverage(language)
    if (proved or 0.0) < cfg.min_proved:
        return "too_little_proved"
    coc = caption.en if language == "en" else caption.zh
    if coc is None or language not in caption.prompt:
        return f"no_{language}"
    answer = dump_json(coc.model_dump())
    parsed = parse_answer(answer, language)
    if parsed.coc is None:  # nothing may be taught that evaluation would call wrong
        return f"answer_{parsed.reason}"
    if PICTURES_MARK not in caption.prompt[language].user:
        raise InputError(
            "the prompt of a caption has no place for the sentence about the pictures",
            where=f"{caption.sample_id}: prompt.{language}",
            expected=f"{PICTURES_MARK} in it",
            fix="run cosfly caption anew",
        )
    pictures = Pictures(cfg.modalities, caption.picture_px, depth_range_m=caption.depth_range_m or DEPTH_RANGE_M)
    folder = f"{caption.town}/{caption.trajectory}/{caption.variant}"
    return Sample(
        sample_id=caption.sample_id,
        language=language,
        town=caption.town,
        trajectory=caption.trajectory,
        variant=caption.variant,
        frames=[f"{folder}/{frame_name(i)}" for i in caption.window],
        views=pictures.views,
        picture_px=pictures.size_px,
        depth_range_m=pictures.depth_range_m,
        prompt=caption.prompt[language].told(pictures.sentence(language)),
        answer=answer,
        decision=parsed.coc.flight_decision,
        label=None if caption.label_from == "perturbed" else caption.label,  # that one holds noise
        repair=None if caption.repair is None else caption.repair.strategy,
        proved=proved,
        weight=_weight(caption, proved, cfg),
    )


def _weight(caption: Caption, proved: float | None, cfg: PrepareConfig) -> float:
    weight = 1.0 if caption.repair is None else cfg.repaired_weight
    return weight * (0.5 + 0.5 * (proved or 0.0)) if cfg.weigh_proved else weight


@dataclass(frozen=True)
class _Window:
    """What the languages of one caption give: samples, and the reasons for leaving others out."""

    sample_id: str
    samples: list[Sample]
    left_out: list[str]

    @property
    def decision(self) -> str:
        """That of the first language, should they differ."""
        return self.samples[0].decision


def _windows(cfg: PrepareConfig, captions: Path, data: Path) -> Iterator[_Window]:
    for caption in read_captions(captions):
        for name in (caption.town, caption.trajectory, caption.variant):
            if name != Path(name).name or name in ("", ".", ".."):
                raise InputError("not a folder name", where=f"{captions}: {caption.sample_id}", got=name)
        folder = stand(data, f"{caption.town}/{caption.trajectory}/{caption.variant}")
        caption.town = folder.parent.parent.name  # the tree may have been converted since
        window = _Window(caption.sample_id, [], [])
        for language in cfg.languages:
            sample = make_sample(caption, language, cfg)
            if isinstance(sample, str):
                window.left_out.append(sample)
            elif not all((data / image).is_file() for image in sample.images):
                window.left_out.append("missing_image")
            else:
                window.samples.append(sample)
        yield window


def run(
    cfg: PrepareConfig, captions: Path, data: Path, out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read `captions.jsonl` and the playback tree `data`; write `train.jsonl`, `val.jsonl` and `test.jsonl` into `out`.

    Returns:
        `out`, the training set.
    Raises:
        NothingKept: no caption can be used. InputError: there are too few trajectories to split.
    """
    inputs = {"captions": captions, "data": data}
    stage = StageFolder.open(out, "distill.prepare", config=cfg, inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return out
    warn_unbound([captions])
    # Two passes: the splits, and what is too much of train, must be known before the first line is written.
    ranks, excluded = _survey(cfg, captions, data, seed)
    if not ranks.groups:
        tally = Tally(input=excluded.total(), dropped=excluded)
        raise stage.nothing_kept(tally, expected="accepted captions whose images stand below --data")
    split_of = assign_splits(ranks.groups, cfg, seed)
    train = [group for group, split in split_of.items() if split == "train"]
    cut = ranks.cut(train, cfg.balance_ratio) if cfg.balance == "decisions" else None
    facts, left_out = _write_splits(cfg, captions, data, out, split_of, cut)
    counts = check_no_leak({split: read_split(out, split) for split in SPLITS}, cfg.split_by)
    if cut is not None:
        excluded += Counter(balance=left_out.total())
        cost = cost_of(cut, left_out)
        facts["train"]["balance"] = cost.model_dump()
        log.info("distill.prepare: %s", cost)
    tally = Tally(input=sum(counts.values()) + excluded.total(), kept=sum(counts.values()), dropped=excluded)
    for split in SPLITS:
        facts[split]["groups"] = sum(1 for owner in split_of.values() if owner == split)
        if not counts[split]:
            log.warning("distill.prepare: the split %s is empty", split)
    stage.finish([split_path(out, split) for split in SPLITS], tally, splits=facts, split_by=cfg.split_by)
    return out


def _survey(cfg: PrepareConfig, captions: Path, data: Path, seed: int) -> tuple[Ranks, Counter[str]]:
    """Go over all windows once: the ranks of those that can be used, and why samples are left out."""
    ranks, excluded = Ranks(seed), Counter[str]()
    for window in _windows(cfg, captions, data):
        excluded.update(window.left_out)
        if window.samples:
            ranks.add(window.samples[0].group(cfg.split_by), window.decision, window.sample_id)
    return ranks, excluded


def _write_splits(
    cfg: PrepareConfig, captions: Path, data: Path, out: Path, split_of: dict[str, Split], cut: Cut | None
) -> tuple[dict[str, dict], Counter[str]]:
    """Write the three files.

    Returns:
        split -> counts of its samples, by language, by decision, repaired; decision -> samples that the cut left out of train.
    """
    names = ("language", "decision", "repair")
    counters: dict[str, dict[str, Counter[str]]] = {split: {name: Counter() for name in names} for split in SPLITS}
    left_out = Counter[str]()
    with ExitStack() as stack:
        files = {split: stack.enter_context(atomic_file(split_path(out, split))) for split in SPLITS}
        for window in _windows(cfg, captions, data):
            for sample in window.samples:
                split = split_of[sample.group(cfg.split_by)]
                if split == "train" and cut is not None and not cut.keeps(window.decision, window.sample_id):
                    left_out[window.decision] += 1
                    continue
                files[split].write((dump_json(sample.model_dump(mode="json")) + "\n").encode())
                counter = counters[split]
                counter["language"][sample.language] += 1
                counter["decision"][sample.decision] += 1
                counter["repair"][sample.repair or "none"] += 1
    facts: dict[str, dict] = {
        split: {
            "samples": found["language"].total(),
            **{f"by_{name}": dict(sorted(counter.items())) for name, counter in found.items()},
        }
        for split, found in counters.items()
    }
    return facts, left_out
