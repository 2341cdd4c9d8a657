"""Phase 4, optional: a language model judges conflicts between a decision and the label; geometry keeps the last word.

A judgement that cannot be read is `unjudged`, never an acceptance. Judgements are kept as a teacher's answers are, and
count in the same budget. `check_judge` measures a judge on a small gold set before its verdicts are used.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from rich.table import Table

from caption.schema import JudgeConfig, Judgement
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import Coc, JudgeRecord, Language
from cosfly.formats.places import flight_of
from cosfly.llm.answers import AnswerBook, Budget, KeptAnswers
from cosfly.llm.client import ChatClient, EndpointConfig
from cosfly.llm.contract import NoAnswer, Request, Troubles, started
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_unpacked
from cosfly.runtime.json_io import Record, dump_json, parse_document, validated
from cosfly.runtime.model_json import find_object

GOLD = Path(__file__).with_name("gold.jsonl.gz")


class PlantedError(Record):
    """One thing made wrong."""

    kind: str
    field: Literal["critical_components", "reasoning_trace", "flight_decision"]
    old: str
    new: str

    def in_text(self, coc: Coc) -> Coc:
        """Return the caption with the error in its text."""
        return coc.model_copy(update={self.field: getattr(coc, self.field).replace(self.old, self.new, 1)})


class GoldCaption(Record):
    """A true caption with its planted errors. label: the decision that its flight took."""

    id: str
    language: Language
    facts: dict[str, Any]  # the measured series by name
    label: str
    critical_components: str
    reasoning_trace: str
    flight_decision: str
    errors: tuple[PlantedError, ...]

    @property
    def coc(self) -> Coc:
        return Coc(**{name: getattr(self, name) for name in Coc.model_fields})


def read_gold(path: Path = GOLD) -> Iterator[GoldCaption]:
    """Yield the captions of a set, by default the one that ships."""
    for number, line in enumerate(read_unpacked(path, what="gold captions").splitlines(), 1):
        where = f"{path}:{number}"
        value = parse_document(line, where)
        yield validated(GoldCaption, value, where)


JUDGEMENTS: tuple[Judgement, ...] = get_args(Judgement)
UNJUDGED = "unjudged"
MAX_TOKENS, MAX_TRIES = 512, 6  # of a judgement

_MEANINGS: dict[Judgement, str] = {
    "ACCEPT_ALTERNATIVE": "the reasoning is sound and its decision is an acceptable alternative to the label",
    "FIX_LABEL": "the reasoning is sound and argues for the label; only the decision field is wrong",
    "REJECT_REGEN": "the reasoning is flawed, or contradicts the flight data, and must be written anew",
}


@dataclass(frozen=True)
class Case:
    """One conflict: the flight data as the teacher read them but for its pictures, its answer, and the true decision
    (None: not known)."""

    sample_id: str
    flight: str
    answer: Coc
    label: str | None


def judge_messages(case: Case, vocabulary: Vocabulary, order: Sequence[Judgement] = JUDGEMENTS) -> list[dict]:
    """Return the chat messages; `order` is the order in which the options are named."""
    options = "\n".join(f"- {name}: {_MEANINGS[name]}." for name in order)
    system = vocabulary.templates["judge_system"].substitute(options=options, names=", ".join(order))
    record = dump_json(case.answer.model_dump(), indent=1)
    told = {"flight": case.flight, "record": record, "label": case.label or "not known"}
    user = vocabulary.templates["judge_user"].substitute(told)
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def judge_schema(order: Sequence[Judgement] = JUDGEMENTS) -> dict:
    properties = {
        "verdict": {"type": "string", "enum": list(order)},
        "reason": {"type": "string", "minLength": 1, "maxLength": 600},
    }
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


def parse_judgement(text: str, finish_reason: str | None = None) -> tuple[str, str]:
    """Read (verdict, reason); a text whose last object does not hold one of the three verdicts and a reason is
    `unjudged`."""
    found = find_object(text, ("verdict", "reason"), finish_reason)
    if found.value is None:
        return UNJUDGED, found.reason or ""
    value = found.value
    verdict, reason = value.get("verdict"), value.get("reason")
    if verdict not in JUDGEMENTS:
        return UNJUDGED, f"no such verdict: {str(verdict)[:40]}"
    if not isinstance(reason, str) or not reason.strip():
        return UNJUDGED, "no reason given"
    return verdict, " ".join(reason.split())


class Judge:
    """Asks an endpoint about conflicts. Made by `open_judge`."""

    def __init__(self, kept: KeptAnswers, cfg: JudgeConfig, vocabulary: Vocabulary, seed: int) -> None:
        self.kept, self.vocabulary = kept, vocabulary
        # The most likely answer.
        self.sampling = {"temperature": 0.0, "seed": seed, "max_tokens": MAX_TOKENS, **cfg.extra_body}

    async def judge(self, case: Case, order: Sequence[Judgement] = JUDGEMENTS) -> JudgeRecord:
        """Judge a case; the verdict is `unjudged` where none could be read or the judge did not answer.

        Raises:
            BudgetSpent: one more request might pass a limit.
        """
        try:
            messages = judge_messages(case, self.vocabulary, order)
            request = Request(messages, [], judge_schema(order), self.sampling)
            reply = await self.kept.ask(request, flight_of(case.sample_id), case.sample_id, "judge")
        except NoAnswer as error:  # not kept: a later run may ask again
            verdict, reason = UNJUDGED, f"no answer: {error}"
        else:
            verdict, reason = parse_judgement(reply.text, reply.finish_reason)
        return JudgeRecord(verdict=verdict, reason=reason, model=self.kept.engine.model)


@asynccontextmanager
async def open_judge(
    cfg: JudgeConfig,
    vocabulary: Vocabulary,
    seed: int,
    book: AnswerBook | None = None,
    budget: Budget | None = None,
    troubles: Troubles | None = None,
) -> AsyncIterator[Judge | None]:
    """Connect to the judge that the settings name; None where they name none.

    Args:
        book: keeps the answers; None: they are not kept. budget: None sets no limit. troubles: notes tries that fail.
    """
    if cfg.url is None:
        yield None
        return
    client = ChatClient(
        cfg.url, EndpointConfig(model=cfg.model, concurrency=cfg.concurrency, max_tries=MAX_TRIES), troubles
    )
    async with started(client):
        yield Judge(KeptAnswers(client, book, budget), cfg, vocabulary, seed)


# --- how good a judge is ----------------------------------------------------------------------------------------------


def gold_conflicts() -> list[tuple[Case, Judgement]]:
    """Return conflicts of the gold set with their right judgements, as many of each.

    A true caption for another decision than the label is an acceptable alternative; with one thing in it made false it
    must be written anew; a true caption for the label of which only the decision was changed has the wrong label field.
    """
    found: dict[Judgement, list[Case]] = {judgement: [] for judgement in JUDGEMENTS}
    for caption in read_gold():
        coc, label = caption.coc, caption.label
        changed = [error.in_text(coc) for error in caption.errors]
        if coc.flight_decision != label:
            false = next(text for text in changed if text.flight_decision == coc.flight_decision)
            found["ACCEPT_ALTERNATIVE"].append(_gold_case(caption, coc, "alternative"))
            found["REJECT_REGEN"].append(_gold_case(caption, false, "false"))
        else:
            wrong = [text for text in changed if text.flight_decision != label]
            found["FIX_LABEL"] += [_gold_case(caption, text, "decision") for text in wrong[:1]]
    count = min(len(cases) for cases in found.values())
    return [(case, judgement) for judgement, cases in found.items() for case in cases[:count]]


def _gold_case(caption: GoldCaption, answer: Coc, kind: str) -> Case:
    facts = caption.facts

    def listed(name: str) -> str:
        return ", ".join("unknown" if value is None else f"{value:g}" for value in facts[name])

    flight = (
        f"Velocity: [{listed('speed_mps')}] m/s.\nAltitude: [{listed('altitude_m')}] m.\n"
        f"Yaw against the first frame: [{listed('yaw_deg')}] deg (positive to the left).\n"
        f"Horizontal distance to the target: [{listed('distance_m')}] m, in 3D: [{listed('slant_m')}] m.\n"
        f"Target ground speed: {facts['target_speed_mps']} m/s, change of its direction: {facts['target_turn_deg']} deg.\n"
        f"Target's box: widths [{listed('box_width_px')}], heights [{listed('box_height_px')}] px; its offset from the "
        f"image centre: "
        f"[{listed('offset_x_px')}] px to the right, [{listed('offset_y_px')}] px down, of {facts['width_px']} x "
        f"{facts['height_px']}.\nVisibility: [{', '.join(facts['visibility'])}]."
    )
    return Case(f"gold_{caption.id}_{kind}_frame_00000", flight, answer, caption.label)


@dataclass(frozen=True)
class JudgeCheck:
    """How a judge did on the gold set, every case asked once per rotation of the options.

    num_agreed, num_unjudged: of `num_asks`. num_moved: cases whose verdict depends on the order of the options.
    first_share: how often it took the option named first, of the answers that could be read; 1/3 is without bias.
    confusion: (gold, judged) -> count.
    """

    model: str
    num_cases: int
    num_asks: int
    num_agreed: int
    num_unjudged: int
    num_moved: int
    first_share: float
    confusion: dict[tuple[str, str], int]

    @property
    def agreement(self) -> float:
        return self.num_agreed / self.num_asks


async def check_judge(
    cfg: JudgeConfig, vocabulary: Vocabulary, gold: list[tuple[Case, Judgement]], seed: int = 0
) -> JudgeCheck:
    """Measure a judge.

    Raises:
        TeacherError: the endpoint cannot be used.
    """
    orders = [(*JUDGEMENTS[i:], *JUDGEMENTS[:i]) for i in range(len(JUDGEMENTS))]
    confusion: Counter[tuple[str, str]] = Counter()
    num_agreed = num_moved = num_first = 0
    async with open_judge(cfg, vocabulary, seed) as judge:
        if judge is None:
            raise InputError("no judge to check", where="--judge", got="nothing", expected="the URL of an endpoint")
        asked = [judge.judge(case, order) for case, _ in gold for order in orders]
        records = iter(await asyncio.gather(*asked))
        for _, right in gold:
            verdicts = [next(records).verdict for _ in orders]
            confusion.update((right, verdict) for verdict in verdicts)
            num_agreed += verdicts.count(right)
            num_moved += len(set(verdicts)) > 1
            num_first += sum(verdict == order[0] for verdict, order in zip(verdicts, orders, strict=True))
        model = f"{judge.kept.engine.model} at {judge.kept.engine.where}"
    num_asks = len(gold) * len(orders)
    num_unjudged = sum(count for (_, verdict), count in confusion.items() if verdict == UNJUDGED)
    first_share = num_first / max(1, num_asks - num_unjudged)
    return JudgeCheck(model, len(gold), num_asks, num_agreed, num_unjudged, num_moved, first_share, dict(confusion))


def judge_check_table(check: JudgeCheck) -> Table:
    """Return the figures as a table for the terminal."""
    table = Table("figure", "value", "meaning", title=f"Judge {check.model}", title_justify="left")
    asks = f"of {check.num_asks} asks ({check.num_cases} cases, three orders of the options)"
    table.add_row("agreement", f"{100 * check.agreement:.1f} %", f"with the gold judgement, {asks}; chance is 33.3 %")
    share = f"{100 * check.first_share:.1f} %"
    table.add_row("position bias", share, "took the option named first; 33.3 % is without bias")
    table.add_row("moved", f"{check.num_moved} of {check.num_cases}", "cases whose verdict depends on the order")
    table.add_row("unparsable", str(check.num_unjudged), f"counted as unjudged, {asks}")
    for gold in JUDGEMENTS:
        row = ", ".join(f"{name} {check.confusion.get((gold, name), 0)}" for name in (*JUDGEMENTS, UNJUDGED))
        table.add_row(f"gold {gold}", str(sum(n for (g, _), n in check.confusion.items() if g == gold)), row)
    return table
