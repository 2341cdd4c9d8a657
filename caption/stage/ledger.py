"""The outcomes of windows: the reasons to drop one, counts that add up, and `report.html`, a page with samples."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, PlainSerializer

from cosfly.formats.captions import TOKENS, Caption, TeacherRecord, Usage, ValueCounts
from cosfly.formats.frames import frame_name
from cosfly.formats.places import flight_of
from cosfly.llm.answers import Answer, BudgetConfig, journal_of
from cosfly.runtime.errors import counts_text
from cosfly.runtime.io import read_text, sha256_bytes
from cosfly.runtime.json_io import FileFormat
from cosfly.runtime.run_dir import Tally
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page

REPORT_FORMAT = FileFormat("cosfly.caption_report", "2.0", "caption report")
NUM_CARDS = 24
# The codes of `drop_reason` and their meanings, for messages and docs/captions.md.
REASONS = {
    "order_to_come": "the order of a mission comes in the window's future; the teacher is not asked",
    "unusable_frame": "a picture of the window is missing or cannot be read; see `checks.frame`",
    "refused": "the server or engine refused the request; see `checks.refusal`",
    "declined": "the model declined to answer; see `checks.refusal`",
    "not_in_file": "the file of captions or predictions has none for this window",
    "structure": "the last answer did not have the requested fields; see `checks.structure`",
    "context_full": "prompt and answer fill the server's context: raise it, or send smaller pictures",
    "conflict": "the decision is in conflict with the trajectory (see `verdict`), and it is not asked again",
    "no_label": "the decision is in conflict, and geometry has no label to anchor a regeneration to",
    "regeneration_failed": "the decision was in conflict, and no regenerated answer was accepted; see `checks.refused`",
    "decision_mismatch": "the action that the model names after its reasoning is not the decision",
    "contradicted_value": "a number of the text contradicts the measured facts; see `checks.contradictions`",
    "invalid_slot": "a slot names no known fact of the window, its braces or unit do not fit, or the words next to it "
    "contradict its value; see `checks.refused`",
    "no_reason": "no observed fact supports a decision, or the label in a regeneration",
    "bilingual": "the two languages do not say the same; see `checks.bilingual`",
}


def most_common(counts: Mapping[str, int]) -> dict[str, int]:
    """Return counts in falling order; equal ones by name."""
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))


def rejections_of(caption: Caption) -> list[str]:
    """Return the codes of why answers of a window were rejected, one for each answer."""
    return [reason.partition(":")[0] for reason in caption.checks.refused or ()]


def explain_drops(dropped: Mapping[str, int], rejected: Mapping[str, int]) -> str:
    """Return the three most common reasons with their counts and meanings; rejected: answers by code."""
    reasons = list(most_common(dropped).items())[:3]
    texts = [f"{count} {reason}: {REASONS[reason]}" for reason, count in reasons]
    if rejected:
        texts.append(f"rejected answers: {counts_text(most_common(rejected))}")
    return "; ".join(texts)


def problems_of(caption: Caption) -> list[tuple[str, str]]:
    """Return what is wrong with the answers of a window: kinds of problems, and their words."""
    checks = caption.checks
    problems = [("structure", checks.structure), ("refusal", checks.refusal)]
    problems += [("answer rejected", reason) for reason in checks.refused or ()]
    problems += [("contradicted", text) for text in checks.contradictions or ()]
    problems.append(("languages", checks.bilingual))
    return [(kind, words) for kind, words in problems if words not in (None, "ok")]


# --- the report -------------------------------------------------------------------------------------------------------

Counts = Annotated[Counter[str], PlainSerializer(most_common)]


class RepairCounts(BaseModel, extra="forbid"):
    """Counts of rejected answers."""

    rejected: int = 0
    outcomes_by_strategy: dict[str, Counts] = {}  # strategy -> the rung that repaired an answer, or the outcome
    asks: Counts = Counter()  # by their number for one answer


class CaptionReport(BaseModel, extra="forbid"):
    """`caption_report.json`: counts of captions, which are added one by one. Counts by a word are in falling order."""

    teacher: TeacherRecord | None = None
    flights: Tally = Tally()  # of tracks
    windows: Tally = Tally()
    asks: int = 0
    tokens: Counts = Counter()
    verdicts_of_first_answers: Counts = Counter()
    verdicts_of_accepted: Counts = Counter()
    labels: Counts = Counter()
    label_from: Counts = Counter()
    confusion_label_to_first_decision: dict[str, Counts] = {}
    repair: RepairCounts = RepairCounts()
    judgements: Counts = Counter()
    structure: Counts = Counter()
    rejected_answers: Counts = Counter()  # of the right structure
    bilingual: Counts = Counter()
    values: dict[str, Counts] = {}  # language -> values_filled, values_matched, values_contradicted
    recovered: Counts = Counter()
    refusals: dict[str, str] = {}  # of dropped windows: code -> last message of a server
    judge_tokens: Usage | None = None  # of all runs into the directory; None if no judge was asked

    def warnings(self) -> list[str]:
        """Return what a reader must know before using the captions."""
        return [
            f"windows got no caption because of {code} ({message}); --retry-failed asks about them again"
            for code, message in self.refusals.items()
        ]

    def add(self, caption: Caption) -> None:
        """Count a caption."""
        label, repair, checks = caption.label or "none", caption.repair, caption.checks
        self.teacher = caption.teacher.model_copy(update={"structured": None})
        self.windows.input += 1
        self.asks += caption.attempts
        self.tokens.update(caption.usage.model_dump())
        self.labels[label] += 1
        self.label_from[caption.label_from] += 1
        if caption.en is not None:
            self.verdicts_of_first_answers[str(repair.first_verdict if repair else caption.verdict)] += 1
            decision = repair.first_decision if repair else caption.en.flight_decision
            self.confusion_label_to_first_decision.setdefault(label, Counter())[decision] += 1
        if repair:
            self.repair.rejected += 1
            self.repair.asks[str(repair.asks)] += 1
            self.repair.outcomes_by_strategy.setdefault(repair.strategy, Counter())[repair.rung or repair.outcome] += 1
        if caption.judge:
            self.judgements[caption.judge.verdict] += 1
            if caption.judge.overruled_by is not None:
                self.judgements[f"overruled_by_{caption.judge.overruled_by}"] += 1
        for language, counts in (checks.values or {}).items():
            self.values.setdefault(language, Counter()).update(counts.model_dump())
        self.structure.update([checks.structure] if checks.structure else [])
        self.rejected_answers.update(rejections_of(caption))
        self.bilingual.update([checks.bilingual] if checks.bilingual else [])
        self.recovered.update(checks.recovered or ())
        if caption.status == "accepted":
            self.windows.kept += 1
            self.verdicts_of_accepted[str(caption.verdict)] += 1
        else:
            # A refused request is a failure of the server, not a fault of the caption.
            tally = self.windows.failed if caption.drop_reason == "refused" else self.windows.dropped
            tally[str(caption.drop_reason)] += 1
            if checks.refusal is not None:
                code, _, message = checks.refusal.partition(": ")
                self.refusals[code] = message

    def finish(self, tracks: Tally, num_unanswered: int, judge_tokens: Usage | None) -> None:
        """Close the counts after the last caption, and check that no window was lost."""
        self.flights = tracks
        self.judge_tokens = judge_tokens
        self.windows.input += num_unanswered
        if num_unanswered:
            self.windows.failed["no_answer"] = num_unanswered
        self.windows.check()


# --- samples for the page ---------------------------------------------------------------------------------------------


class SampleCards:
    """Samples captions of every kind for the page: those of the smallest hash, in whatever order they come."""

    def __init__(self) -> None:
        self._kinds: dict[str, list[Caption]] = {}  # dropped, repaired, or the verdict -> captions

    def add(self, caption: Caption) -> None:
        kind = "dropped" if caption.status == "dropped" else "repaired" if caption.repair else str(caption.verdict)
        cards = self._kinds.setdefault(kind, [])
        cards.append(caption)
        cards.sort(key=lambda card: sha256_bytes(card.sample_id.encode()))
        del cards[NUM_CARDS:]

    def chosen(self) -> list[Caption]:
        """Return up to NUM_CARDS captions, the kinds in turn, sorted by id."""
        turns = zip_longest(*(self._kinds[kind] for kind in sorted(self._kinds)))
        captions = [card for turn in turns for card in turn if card is not None]
        return sorted(captions[:NUM_CARDS], key=lambda caption: caption.sample_id)


# --- the page ---------------------------------------------------------------------------------------------------------

PICTURE_WIDTH_PX, CARD_FRAMES = 240, 5  # of the pictures of a sample
VERDICTS = {  # with their meanings
    "CONSISTENT": "the decision is the label",
    "SOFT_CONFLICT": "another decision, which the trajectory does not contradict",
    "HARD_CONFLICT": "the trajectory contradicts the decision",
    "ABSTAIN": "geometry cannot decide",
}
LANGUAGE_NAMES = {"en": "English", "zh": "Chinese"}
STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))


def page_html(
    report: CaptionReport, cards: Sequence[Caption], folders: Mapping[str, Path], answers: Path, budget: BudgetConfig,
    name: str,
) -> str:  # fmt: skip
    """Return the page of a run with this name. cards: Captions to show. folders: Of the tracks by id, for pictures.
    answers: Folder of the journals."""
    return page(
        "caption/stage/report.html", title=name, style=STYLE, report=report, meanings=VERDICTS,
        values=tuple(ValueCounts.model_fields), language_names=LANGUAGE_NAMES, most_common=most_common,
        tokens=TOKENS, cost=_cost(report, budget), cards=[_card(caption, folders, answers) for caption in cards],
    )  # fmt: skip


def _cost(report: CaptionReport, budget: BudgetConfig) -> list[tuple[str, str]]:
    """Return the rows of the table of tokens and cost, those of the judge included."""
    prompt, answer = report.tokens["prompt_tokens"], report.tokens["completion_tokens"]
    num_accepted, judge = report.windows.kept, report.judge_tokens
    rows = [("prompt tokens", f"{prompt:,}"), ("answer tokens", f"{answer:,}")]
    if judge is not None:
        rows.append(("the judge's tokens", f"{judge.prompt_tokens:,} in, {judge.completion_tokens:,} out"))
        prompt += judge.prompt_tokens
        answer += judge.completion_tokens
    if num_accepted:
        rows.append(("tokens per accepted caption", f"{(prompt + answer) / num_accepted:,.0f}"))
    if not (budget.price_prompt or budget.price_completion):
        return [*rows, ("cost", "no prices set")]
    cost = budget.cost(prompt, answer)
    rows.append(("cost", f"{cost:,.2f}"))
    if num_accepted:
        rows.append(("cost per 1,000 accepted", f"{1000 * cost / num_accepted:,.2f}"))
    return rows


def _card(caption: Caption, folders: Mapping[str, Path], answers: Path) -> dict[str, Any]:
    """Return a caption with the indices and thumbnails of its last frames, None in place of a missing thumbnail, its
    problems, and the recorded answers of a dropped window."""
    pictures: dict[int, str | None] = dict.fromkeys(caption.window[-CARD_FRAMES:])
    if folder := folders.get(flight_of(caption.sample_id)):
        for index in pictures:
            pictures[index] = thumbnail(folder / frame_name(index), PICTURE_WIDTH_PX, jpeg_quality=75)
    texts = []
    if caption.status == "dropped":
        journal = journal_of(answers, flight_of(caption.sample_id)).read_as(Answer.model_validate)
        texts = [answer.text for answer in journal if answer.sample_id == caption.sample_id]
    return {
        "caption": caption, "pictures": list(pictures.items()), "problems": problems_of(caption), "answers": texts,
    }  # fmt: skip
