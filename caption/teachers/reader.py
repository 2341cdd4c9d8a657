"""Reads somebody else's prose into claims: language models say what each sentence states, geometry says whether that is
true.

A reader sees the sentences alone, no facts. Two readings are made of each text, by two models or by one that is asked
in two orders; only what both say is judged. Each claim quotes the words it stands for, which must occur; a sentence is
proved only if the quotes hold every numeral and every measurable word of it. `check_reader` measures a reader on the
gold set before it is believed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from rich.table import Table

from caption.schema import EvidenceConfig, Judged, ReaderConfig
from caption.teachers.asked import AskedModel, figures_table, open_models, share_text
from caption.truth.claims import claim_name, goes_against, judge_claim, references_of
from caption.truth.facts import Facts
from caption.truth.gold import GoldCaption
from caption.truth.references import QUANTITIES
from caption.truth.said import SCENE
from caption.truth.sizes import numeral_of
from caption.truth.stated import read_stated
from caption.truth.vocabulary import Vocabulary
from caption.writing.claims import QUOTED_SCHEMA, read_quoted
from caption.writing.contract import Draft, WayOfWriting
from cosfly.chat.answers import AnswerBook
from cosfly.chat.budget import Budget, BudgetConfig
from cosfly.chat.contract import NoAnswer, Troubles
from cosfly.errors import InputError
from cosfly.products.actions import ActionSet
from cosfly.products.captions import Claim, Coc, Language, ReaderRecord, SentenceState, Usage
from cosfly.products.sentences import sentences_of
from cosfly.reading.objects import find_object
from cosfly.work.store import sha256_bytes

READINGS = 2
SCHEMA = {
    "type": "object",
    "properties": {"claims": QUOTED_SCHEMA},
    "required": ["claims"],
    "additionalProperties": False,
}


def reader_messages(coc: Coc, facts: Facts, order: int, vocabulary: Vocabulary) -> list[dict]:
    """Give the chat messages of a reading; of the facts only the number of frames is told. order: 1 names all things
    backwards."""
    quantities, sentences = list(QUANTITIES), [f"{name}: {text}" for name, text in sentences_of(coc)]
    if order:
        quantities, sentences = quantities[::-1], sentences[::-1]
    system = vocabulary.templates["reader_system"].substitute(
        num_frames=len(facts), last=f"t{len(facts) - 1}", step_s=f"{facts.step_s:g}",
        quantities=", ".join(quantities), actions=", ".join(vocabulary.actions.tokens),
    )  # fmt: skip
    user = vocabulary.templates["reader_user"].substitute(sentences="\n".join(sentences))
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def prompt_digest(vocabulary: Vocabulary) -> str:
    """Give the digest of the prompts that a reader is asked with."""
    texts = [vocabulary.templates[name].template for name in ("reader_system", "reader_user")]
    return sha256_bytes("\x00".join(texts).encode())[:16]


def read_reading(text: str, finish_reason: str | None, coc: Coc, language: Language) -> list[Claim] | None:
    """Read the claims of an answer; None where it is none. Left out are claims that are malformed, that quote what
    their sentence does not hold, or whose number their quote does not hold."""
    found = find_object(text, ("claims",), finish_reason).value
    if found is None or not isinstance(found.get("claims"), list):
        return None
    return read_quoted(found["claims"], dict(sentences_of(coc)), language)


def agreed(one: Iterable[Claim], other: Iterable[Claim], num_frames: int) -> list[Claim]:
    """Give the claims of one reading that stand in the other, too: the same of the same sentence, each once."""
    theirs = {_key(claim, num_frames) for claim in other}
    return list({key: claim for claim in one if (key := _key(claim, num_frames)) in theirs}.values())


def _key(claim: Claim, num_frames: int) -> tuple:
    """Give what a claim says, however its address is written."""
    if claim.at is None and claim.quantity in QUANTITIES:
        claim = claim.model_copy(update={"at": f"t{num_frames - 1}"})
    elif claim.at is None and ":" in claim.quantity:
        claim = claim.model_copy(update={"at": f"t0-t{num_frames - 1}"})
    where = tuple(references_of(claim)) or (claim.quantity, claim.at)
    return claim.sentence, where, claim.value, claim.unit, claim.modality


# --- judging ----------------------------------------------------------------------------------------------------------


def judge_reading(
    coc: Coc, claims: Sequence[Claim], facts: Facts, cfg: EvidenceConfig, language: Language, actions: ActionSet
) -> list[Judged]:
    """Compare what both readings say with the facts; gives the state of every sentence, in order.

    A claim that cannot be compared is the reader's fault and makes its sentence unread, not contradicted.
    """
    judged = []
    for name, text in sentences_of(coc):
        about = cfg if read_stated(text, language).is_approximate else None
        own, states, problems = [claim for claim in claims if claim.sentence == name], set[str](), list[str]()
        for claim in own:
            if claim.quantity == SCENE or claim.modality == "hypothetical":
                continue
            if claim.quantity == "decision" or claim.modality == "predicted":
                if goes_against(claim, coc.flight_decision, actions):
                    problems.append(f"decision: {claim_name(claim)}, not {coc.flight_decision}")
                continue
            numeral = numeral_of(text, claim, language) if isinstance(claim.value, float) else None
            state = judge_claim(claim, facts, about, numeral)
            states.add(state)
            if state == "contradicted":
                problems.append(f"false: {claim_name(claim)}")
        is_proved = states == {"proved"} and is_covered(text, own, language)
        found: SentenceState = "contradicted" if problems else "proved" if is_proved else "unread"
        judged.append(Judged(name, text, found, tuple(dict.fromkeys(problems))))
    return judged


def judge_text(
    draft: Draft, way: WayOfWriting, reader: ReaderRecord | None, facts: Facts, cfg: EvidenceConfig, language: Language
) -> list[Judged]:
    """Give the state of every sentence of a text from what stands in its record, which asks nobody.

    reader: what it proves or contradicts counts; a sentence that it leaves unread keeps what was found without it.
    """
    judged = way.judge(draft, facts, cfg, language)
    if reader is None or language not in reader.claims:
        return judged
    read = judge_reading(draft.coc, reader.claims[language], facts, cfg, language, way.vocabulary.actions)
    return [one if one.state != "unread" else other for one, other in zip(read, judged, strict=True)]


def is_covered(text: str, claims: Iterable[Claim], language: Language) -> bool:
    """Tell whether every numeral and measurable word of a sentence lies in a quote."""
    stated = read_stated(text, language)
    words = [(n.start, n.start + len(n.text)) for n in stated.numerals]
    words += [(pole.start, pole.start + len(pole.word)) for pole in stated.poles if not pole.is_scenery]
    spans = []
    for quote in {read_stated(claim.quote or "", language).text for claim in claims}:
        start = stated.text.find(quote)
        if quote and start >= 0:
            spans.append((start, start + len(quote)))
    return all(any(first <= start and end <= last for first, last in spans) for start, end in words)


# --- asking -----------------------------------------------------------------------------------------------------------


@dataclass
class Read:
    """What was read in one text. num_claims: of each reading; None: it could not be read."""

    claims: list[Claim] = field(default_factory=list)
    num_claims: list[int | None] = field(default_factory=list)
    usage: Usage = field(default_factory=Usage)


class Reader:
    """Asks one or two endpoints what texts state. Made by `open_reader`."""

    def __init__(self, models: Sequence[AskedModel], vocabulary: Vocabulary) -> None:
        self.models, self.vocabulary = models, vocabulary

    @property
    def names(self) -> list[str]:
        return [model.name for model in self.models]

    async def read(self, coc: Coc, facts: Facts, language: Language, sample_id: str) -> Read:
        """Read a text twice. What cannot be read, or is refused, states nothing."""
        asked = [self._reading(number, coc, facts, language, sample_id) for number in range(READINGS)]
        readings = await asyncio.gather(*asked)
        read = Read(num_claims=[None if claims is None else len(claims) for claims, _ in readings])
        read.usage = sum((usage for _, usage in readings), Usage())
        (one, _), (other, _) = readings
        if one is not None and other is not None:
            read.claims = agreed(one, other, len(facts))
        return read

    async def _reading(
        self, number: int, coc: Coc, facts: Facts, language: Language, sample_id: str
    ) -> tuple[list[Claim] | None, Usage]:
        model = self.models[number % len(self.models)]
        messages = reader_messages(coc, facts, number, self.vocabulary)
        try:
            reply = await model.ask(messages, SCHEMA, sample_id, f"read_{language}/{number}")
        except NoAnswer as error:
            if model.kept.book is not None and not error.is_final:
                raise  # of a run: the window is asked about again
            return None, Usage()
        return read_reading(reply.text, reply.finish_reason, coc, language), reply.usage or Usage()

    async def record(self, texts: dict[Language, Coc], facts: Facts, sample_id: str) -> ReaderRecord:
        """Read the texts of a caption; raises as `read`."""
        found = await asyncio.gather(*(self.read(coc, facts, language, sample_id) for language, coc in texts.items()))
        reads = dict(zip(texts, found, strict=True))
        return ReaderRecord(
            models=self.names,
            prompt=prompt_digest(self.vocabulary),
            claims={language: read.claims for language, read in reads.items()},
            num_claims={language: read.num_claims for language, read in reads.items()},
            usage=sum((read.usage for read in found), Usage()),
        )


@asynccontextmanager
async def open_reader(
    cfg: ReaderConfig,
    vocabulary: Vocabulary,
    seed: int,
    book: AnswerBook | None = None,
    budget: Budget | None = None,
    troubles: Troubles | None = None,
) -> AsyncIterator[Reader | None]:
    """Connect to the reader that the settings name; None where they name none. Arguments and errors as of
    `open_models`."""
    if not cfg.urls:
        yield None
        return
    where = [(url, cfg.models[i] if i < len(cfg.models) else None) for i, url in enumerate(cfg.urls)]
    async with open_models(cfg, where, seed, book, budget, troubles) as models:
        yield Reader(models, vocabulary)


# --- how good a reader is ---------------------------------------------------------------------------------------------


@dataclass
class ReaderCheck:
    """How a reader did on the gold set: true captions flagged, captions with one planted error caught."""

    models: list[str]
    num_true: int = 0
    num_flagged: int = 0
    num_false: int = 0
    num_caught: int = 0
    num_sentences: int = 0
    num_proved: int = 0
    num_false_proved: int = 0  # captions with an error, all of whose sentences are proved
    num_claims: int = 0
    num_unreadable: int = 0  # of readings
    num_requests: int = 0
    usage: Usage = field(default_factory=Usage)


async def check_reader(
    cfg: ReaderConfig, vocabulary: Vocabulary, gold: Sequence[GoldCaption], seed: int = 0
) -> ReaderCheck:
    """Measure the reader that the settings name."""
    async with open_reader(cfg, vocabulary, seed) as reader:
        if reader is None:
            raise InputError("no reader to check", where="--reader", got="nothing", expected="the URL of an endpoint")
        return await measure_reader(reader, gold)


async def measure_reader(reader: Reader, gold: Sequence[GoldCaption]) -> ReaderCheck:
    """Have every caption read as it stands, and with each error that can be planted in its text."""
    check = ReaderCheck(reader.names)
    texts = [(caption, caption.coc, True) for caption in gold]
    texts += [(caption, error.in_text(caption.coc), False) for caption in gold for error in caption.errors]
    asked = [reader.read(coc, gold.facts, gold.language, f"gold_{gold.id}_frame_00000") for gold, coc, _ in texts]
    for (caption, coc, is_true), read in zip(texts, await asyncio.gather(*asked), strict=True):
        actions = reader.vocabulary.actions
        judged = judge_reading(coc, read.claims, caption.facts, EvidenceConfig(), caption.language, actions)
        _count(check, judged, read, is_true)
    return check


def _count(check: ReaderCheck, judged: list[Judged], read: Read, is_true: bool) -> None:
    states = [one.state for one in judged]
    is_flagged = "contradicted" in states
    check.num_requests += READINGS
    check.usage += read.usage
    check.num_unreadable += read.num_claims.count(None)
    if is_true:
        check.num_true += 1
        check.num_flagged += is_flagged
        check.num_sentences += len(states)
        check.num_proved += states.count("proved")
        check.num_claims += len(read.claims)
    else:
        check.num_false += 1
        check.num_caught += is_flagged
        check.num_false_proved += set(states) == {"proved"}


def reader_check_table(check: ReaderCheck, prices: BudgetConfig = BudgetConfig()) -> Table:
    """Give the figures as a table for the terminal."""
    table = figures_table(f"Reader {', '.join(check.models)}")

    def share(name: str, count: int, total: int, meaning: str) -> None:
        table.add_row(name, share_text(count, total), f"{meaning}; {count} of {total}")

    share("flagged", check.num_flagged, check.num_true, "true captions with a sentence called contradicted")
    share(
        "caught",
        check.num_caught,
        check.num_false,
        "captions with one error, in which a sentence is called contradicted",
    )
    share(
        "false but proved",
        check.num_false_proved,
        check.num_false,
        "captions with one error, all of them called proved",
    )
    share("proved", check.num_proved, check.num_sentences, "sentences of true captions")
    claims = check.num_claims / max(1, check.num_sentences)
    table.add_row("claims a sentence", f"{claims:.2f}", "that both readings state, of true captions")
    table.add_row(
        "unreadable", str(check.num_unreadable), f"answers that hold no claims, of {check.num_requests} requests"
    )
    table.add_row("tokens", f"{check.usage.total:,}", f"in {check.num_requests} requests")
    if prices.price_prompt or prices.price_completion:
        cost = prices.cost(check.usage.prompt_tokens, check.usage.completion_tokens)
        a_caption = cost * READINGS / max(1, check.num_requests)
        table.add_row("cost", f"{cost:,.4f}", f"{a_caption:.6f} a caption and language")
    return table
