"""A caption to the samples of its languages, or the words for why there are none."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from cosfly.errors import InputError
from cosfly.look.frame_views import DEPTH_RANGE_M, Pictures, View
from cosfly.products.answer_text import parse_answer
from cosfly.products.captions import PICTURES_MARK, Caption, Language, Verdict
from cosfly.products.places import FlightChoice
from cosfly.work.store import dump_json
from distill.prepare.splitting import SplitConfig
from distill.schema import Sample

Rung = Literal["hint", "multi_sample", "anchored", "fix_label"]


class PrepareConfig(SplitConfig):
    """Settings of `distill prepare`."""

    flights: FlightChoice = Field(FlightChoice(), description="which flights of the trees")
    languages: tuple[Language, ...] = Field(
        ("en", "zh"), min_length=1, description="answers to learn, each language as samples of its own"
    )
    modalities: tuple[View, ...] = Field(
        ("rgb",),
        description="pictures of each window frame, in this order: rgb, depth, segmentation, middle (the middle third of rgb, enlarged, "
        "wherever the person is); none: text alone",
    )
    text_state: bool = Field(
        True, description="the prompt holds what was measured on the frames, and the mission; false: pictures alone"
    )
    unbound: Literal["refuse", "accept"] = Field(
        "refuse",
        description="captions of which no record says from which tree they were made, as after copying the file alone: another tree's "
        "would go unseen",
    )
    repaired: Literal["keep", "exclude"] = Field("keep", description="what happens to captions that a repair made")
    rungs: tuple[Rung, ...] = Field(
        ("hint", "multi_sample", "anchored", "fix_label"),
        description="repaired captions are learnt that one of these asks mended",
    )
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

    limit: int = Field(
        0, ge=0, description="windows in all splits together, of each decision and flight its share; 0: all there are"
    )

    @model_validator(mode="after")
    def _there_is_something_to_learn(self) -> PrepareConfig:
        if not self.modalities and not self.text_state:
            raise ValueError("without pictures and text_state there is nothing to answer from")
        if len(set(self.languages)) < len(self.languages) or len(set(self.modalities)) < len(self.modalities):
            raise ValueError("languages and modalities may name each entry once")
        return self


def make_sample(
    caption: Caption, language: Language, cfg: PrepareConfig, *, run: str = "", walk: str = "", sample_id: str = ""
) -> Sample | str:
    """Give the sample of a caption in one language, or the word for why there is none.

    Args:
        run, walk: of its flight. sample_id: unique among the samples of all runs; "" takes the caption's.
    Raises:
        InputError: the prompt cannot say which pictures the student gets.
    """
    if reason := _reason_to_leave_out(caption, language, cfg):
        return reason
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
    is_noisy = caption.label_from == "perturbed"  # and so is what that future rules out
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
        contradicted=None if is_noisy or (ruled_out := caption.checks.contradicted) is None else tuple(ruled_out),
        repair=None if caption.repair is None else caption.repair.strategy,
        proved=caption.coverage(language),
        weight=_weight(caption, caption.coverage(language), cfg),
    )


def _reason_to_leave_out(caption: Caption, language: Language, cfg: PrepareConfig) -> str | None:
    """Give the word for why the settings leave a caption out, by its record alone; None: they take it."""
    if caption.status != "accepted":
        return f"dropped_{caption.drop_reason or 'unknown'}"
    if caption.repair is not None and cfg.repaired == "exclude":
        return "repaired"
    if caption.repair is not None and caption.repair.rung not in (None, *cfg.rungs):
        return f"repaired_by_{caption.repair.rung}"
    if caption.verdict not in cfg.verdicts:
        return f"verdict_{str(caption.verdict).lower()}"
    if cfg.contradicted == "exclude" and "contradicted" in (caption.checks.sentences or {}).get(language, []):
        return "contradicted"
    if (caption.coverage(language) or 0.0) < cfg.min_proved:
        return "too_little_proved"
    return None


def _weight(caption: Caption, proved: float | None, cfg: PrepareConfig) -> float:
    weight = 1.0 if caption.repair is None else cfg.repaired_weight
    return weight * (0.5 + 0.5 * (proved or 0.0)) if cfg.weigh_proved else weight
