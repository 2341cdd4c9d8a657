"""Phase 4, optional: a language model judges conflicts between a decision and the label. Geometry has the last word.

A judgement that cannot be read is `unjudged`, never an acceptance. Judgements are journaled like a teacher's answers
and count in the same budget. `check_judge` measures a judge on a small gold set before its verdicts are used.
"""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from caption.schema import JudgeConfig, Judgement
from caption.teachers.prompt_files import Vocabulary
from cosfly.formats.captions import Coc, JudgeRecord
from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import object_schema
from cosfly.llm.answers import AnswerBook, Budget, KeptAnswers
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import NoAnswer, started
from cosfly.runtime.console import progress_bar
from cosfly.runtime.io import read_unpacked
from cosfly.runtime.json_io import Record, dump_json, parse_document, validated
from cosfly.runtime.model_json import find_object

GOLD = Path(__file__).with_name("gold.jsonl.gz")
JUDGEMENTS: tuple[Judgement, ...] = get_args(Judgement)
UNJUDGED = "unjudged"

_MEANINGS: dict[Judgement, str] = {
    "ACCEPT_ALTERNATIVE": "the reasoning is sound and its decision is an acceptable alternative to the label",
    "FIX_LABEL": "the reasoning is sound and argues for the label; only the decision field is wrong",
    "REJECT_REGEN": "the reasoning is flawed, or contradicts the flight data, and must be written again",
}


class Conflict(Record):
    """An answer whose decision is not the label."""

    sample_id: str
    flight_data: str  # the question without its pictures
    answer: Coc
    label: str | None  # None if it is not known


def judge_messages(conflict: Conflict, vocabulary: Vocabulary, order: Sequence[Judgement] = JUDGEMENTS) -> list[dict]:
    """Return the chat messages; `order` is the order in which the options are named."""
    options = "\n".join(f"- {name}: {_MEANINGS[name]}." for name in order)
    system = vocabulary.templates["judge_system"].substitute(options=options, names=", ".join(order))
    user = vocabulary.templates["judge_user"].substitute(
        flight=conflict.flight_data,
        record=dump_json(conflict.answer.model_dump(), indent=1),
        label=conflict.label or "not known",
    )
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def parse_judgement(text: str, finish_reason: str | None = None) -> tuple[str, str]:
    """Return the verdict and the reason of the last object of a text; `unjudged` if either is missing."""
    judgement = find_object(text, ("verdict", "reason"), finish_reason)
    if judgement.value is None:
        return UNJUDGED, judgement.reason or ""
    verdict, reason = judgement.value.get("verdict"), judgement.value.get("reason")
    if verdict not in JUDGEMENTS:
        return UNJUDGED, f"unknown verdict: {str(verdict)[:40]}"
    if not isinstance(reason, str) or not reason.strip():
        return UNJUDGED, "no reason given"
    return verdict, " ".join(reason.split())


class Judge:
    """A model that is asked about conflicts. Made by `open_judge`."""

    def __init__(self, kept: KeptAnswers, cfg: JudgeConfig, vocabulary: Vocabulary, seed: int) -> None:
        self.kept, self.cfg, self.vocabulary, self.seed = kept, cfg, vocabulary, seed

    async def judge(self, conflict: Conflict, order: Sequence[Judgement] = JUDGEMENTS) -> JudgeRecord:
        """Return the verdict on a conflict, `unjudged` without a readable answer. BudgetSpent: A limit is reached."""
        messages = judge_messages(conflict, self.vocabulary, order)
        verdicts = {"type": "string", "enum": list(order)}
        schema = object_schema({"verdict": verdicts, "reason": {"type": "string", "minLength": 1, "maxLength": 600}})
        request = self.cfg.request(messages, [], schema, self.seed)
        try:
            reply = await self.kept.ask(request, flight_of(conflict.sample_id), conflict.sample_id, "judge")
        except NoAnswer as error:  # not journaled: a later run may ask again
            verdict, reason = UNJUDGED, f"no answer: {error}"
        else:
            verdict, reason = parse_judgement(reply.text, reply.finish_reason)
        return JudgeRecord(verdict=verdict, reason=reason, model=self.kept.engine.model)


@asynccontextmanager
async def open_judge(
    cfg: JudgeConfig, vocabulary: Vocabulary, seed: int, book: AnswerBook | None = None, budget: Budget | None = None
) -> AsyncIterator[Judge | None]:
    """Connect to the judge of the settings, None if they name none; `book` is the journal of its answers."""
    if cfg.url is None:
        yield None
        return
    client = ChatClient(cfg.url, cfg)
    async with started(client):
        yield Judge(KeptAnswers(client, book, budget), cfg, vocabulary, seed)


# --- how good a judge is ----------------------------------------------------------------------------------------------


class GoldConflict(Conflict):
    """A conflict with its right judgement: a true caption for another decision than the label, the same with a planted
    error, or a true caption for the label with a changed decision."""

    judgement: Judgement


def gold_conflicts() -> list[GoldConflict]:
    """Read the gold set: as many conflicts of each judgement."""
    lines = read_unpacked(GOLD, what="gold conflicts").splitlines()
    return [validated(GoldConflict, parse_document(line, GOLD), GOLD) for line in lines]


@dataclass(frozen=True)
class JudgeCheck:
    """How a judge did on the gold set. Every conflict is asked once per rotation of the options."""

    model: str
    num_conflicts: int
    num_moved: int  # conflicts whose verdict depends on the order of the options
    num_first: int  # answers that took the option named first
    confusion: Counter[tuple[str, str]]  # (gold, judged) -> answers

    @property
    def agreement(self) -> float:
        return sum(self.confusion[name, name] for name in JUDGEMENTS) / self.confusion.total()

    @property
    def num_unjudged(self) -> int:
        return sum(self.confusion[name, UNJUDGED] for name in JUDGEMENTS)

    @property
    def first_share(self) -> float:
        """Share of the readable answers that took the option named first; 1/3 is without bias."""
        return self.num_first / max(1, self.confusion.total() - self.num_unjudged)

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the figures as rows of a table: figure, value, meaning."""
        asks = f"of {self.confusion.total()} answers ({self.num_conflicts} cases, three orders of the options)"
        rows = [
            ("agreement", f"{self.agreement:.1%}", f"with the gold judgement, {asks}; chance is 33.3%"),
            ("position bias", f"{self.first_share:.1%}", "answers that chose the first option; without bias 33.3%"),
            ("moved", f"{self.num_moved} of {self.num_conflicts}", "cases whose verdict depends on the order"),
            ("unparsable", str(self.num_unjudged), f"counted as unjudged, {asks}"),
        ]
        for gold in JUDGEMENTS:
            counts = {name: self.confusion[gold, name] for name in (*JUDGEMENTS, UNJUDGED)}
            row = ", ".join(f"{name} {count}" for name, count in counts.items())
            rows.append((f"gold {gold}", str(sum(counts.values())), row))
        return rows


async def check_judge(cfg: JudgeConfig, vocabulary: Vocabulary, gold: list[GoldConflict], seed: int = 0) -> JudgeCheck:
    """Measure the judge of the settings; TeacherError if the endpoint cannot be used."""
    orders = [(*JUDGEMENTS[i:], *JUDGEMENTS[:i]) for i in range(len(JUDGEMENTS))]
    confusion: Counter[tuple[str, str]] = Counter()
    num_moved = num_first = 0
    with progress_bar("judge-check", len(gold) * len(orders)) as advance:
        async with open_judge(cfg, vocabulary, seed) as judge:
            assert judge is not None  # the settings name one

            async def ask(conflict: GoldConflict, order: Sequence[Judgement]) -> JudgeRecord:
                record = await judge.judge(conflict, order)
                advance(1)
                return record

            records = await asyncio.gather(*(ask(conflict, order) for conflict in gold for order in orders))
            model = f"{judge.kept.engine.model} at {judge.kept.engine.where}"
    for k, conflict in enumerate(gold):
        verdicts = [record.verdict for record in records[k * len(orders) : (k + 1) * len(orders)]]
        confusion.update((conflict.judgement, verdict) for verdict in verdicts)
        num_moved += len(set(verdicts)) > 1
        num_first += sum(verdict == order[0] for verdict, order in zip(verdicts, orders, strict=True))
    return JudgeCheck(model, len(gold), num_moved, num_first, confusion)
