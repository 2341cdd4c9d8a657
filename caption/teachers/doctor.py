"""`cosfly caption doctor URL`: what an endpoint can really do, found by trying, before a run pays for it.

Servers answer 200 to much that they ignore: a schema, images, a limit. Each check therefore asks for something whose
effect shows in the answer or in the token count.
"""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import httpx
import numpy as np

from caption.schema import CaptionConfig, ObservedWindow, observed_frames
from caption.teachers.asked import AskedModel
from caption.teachers.prompts import (
    MAX_RETURNED_CHARACTERS,
    Correction,
    correction_messages,
    make_question,
    text_of,
    way_prompt,
)
from caption.teachers.reader import Reader, measure_reader
from caption.teachers.trials import NO_ANSWER, best_way, try_ways
from caption.truth.gold import read_gold
from caption.truth.vocabulary import Vocabulary
from caption.writing.contract import WAYS, more_fields, way_of
from cosfly.chat.answers import KeptAnswers
from cosfly.chat.client import ChatServer
from cosfly.chat.contract import Request
from cosfly.chat.protocol import (
    ERROR_INSTEAD,
    THOUGHT_FIELDS,
    final_text,
    read_body,
    request_body,
    response_format,
    split_urls,
)
from cosfly.chat.refusals import MEANINGS, Refusal
from cosfly.chat.servers import ChatClient
from cosfly.chat.wire import Response
from cosfly.errors import TeacherError
from cosfly.look.frame_views import VIEW_FILES
from cosfly.products.answer_text import answer_schema, parse_answer
from cosfly.products.captions import Writing
from cosfly.reading.documents import parse_json

State = Literal["ok", "warning", "unusable"]

TRIES = 3
READ_CAPTIONS = 4
MAX_COMPLAINT = 2000  # characters that a complaint hardly ever takes
ODD_WORD = "zebra-41"  # what no model writes to a greeting unless it is made to
NO_THINKING = "endpoint.extra_body={chat_template_kwargs: {enable_thinking: false}}"


@dataclass(frozen=True)
class Finding:
    """One line of the table. `unusable`: captioning cannot work; `warning`: it can, and what to know."""

    name: str
    state: State
    detail: str


def examine_endpoint(
    url: str, cfg: CaptionConfig, vocabulary: Vocabulary, ways: Sequence[Writing] = tuple(WAYS), as_reader: bool = False
) -> list[Finding]:
    """Try an endpoint. It is usable if no finding is `unusable`.

    Args:
        url: an address, or several with commas between: each is tried, and then whether all serve one model.
        ways: of writing that are tried. as_reader: none is, it reads prose of others and sees no picture.
    """
    try:
        urls = split_urls(url)
    except ValueError as error:
        raise TeacherError(str(error)) from None
    if len(urls) == 1:
        return asyncio.run(_Examination(url, cfg, vocabulary, ways, as_reader).run())
    found = [(one, asyncio.run(_Examination(one, cfg, vocabulary, ways, as_reader).run())) for one in urls]
    findings = [replace(finding, name=f"{one}: {finding.name}") for one, findings in found for finding in findings]
    models = {
        one: next(finding.detail for finding in findings if finding.state == "ok")
        for one, findings in found
        if findings[0].state == "ok"
    }
    if len(set(models.values())) > 1:
        listed = ", ".join(f"{one}: {model}" for one, model in models.items())
        findings.append(Finding("one model", "unusable", f"they serve different ones: {listed}; leave some out"))
    return findings


# --- what one request gave --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Probe:
    """What one request gave, read without trust, since any field may be of another kind than it should be. `value` is
    the decoded body of a 200, else None and `detail` tells why; refusal: what the server meant."""

    value: dict[str, Any] | None
    detail: str
    seconds: float
    refusal: Refusal | None = None

    @property
    def _choice(self) -> dict:
        choices = (self.value or {}).get("choices")
        first = choices[0] if isinstance(choices, list) and choices else {}
        return first if isinstance(first, dict) else {}

    @property
    def message(self) -> dict:
        message = self._choice.get("message")
        return message if isinstance(message, dict) else {}

    @property
    def text(self) -> str:
        return final_text(self.message) or ""

    @property
    def finish_reason(self) -> str | None:
        reason = self._choice.get("finish_reason")
        return reason if isinstance(reason, str) else None

    @property
    def prompt_tokens(self) -> int | None:
        return self._count("prompt_tokens")

    @property
    def completion_tokens(self) -> int | None:
        return self._count("completion_tokens")

    @property
    def thoughts(self) -> str:
        """What it says before its answer, where a server tells that apart."""
        thoughts = (self.message.get(name) for name in THOUGHT_FIELDS)
        return next((text for text in thoughts if isinstance(text, str) and text), "")

    @property
    def is_too_long(self) -> bool:
        return self.refusal is not None and self.refusal.kind == "too_long"

    def _count(self, name: str) -> int | None:
        usage = (self.value or {}).get("usage")
        count = usage.get(name) if isinstance(usage, dict) else None
        return count if type(count) is int else None


def read_probe(response: Response, request: Request, client: ChatServer, seconds: float) -> Probe:
    """Read a response; `seconds`: what it took."""
    found = client.read(response, request, is_structured=False)
    if isinstance(found, Refusal):
        fix = "" if found.kind == "unknown" else f"; {found.meaning.fix}"
        return Probe(None, found.said + fix, seconds, found)
    if response.is_cut or (isinstance(found, str) and found.startswith(ERROR_INSTEAD)):
        return Probe(None, str(found), seconds)
    try:
        value = read_body(response.body)
    except ValueError:
        return Probe(None, "the body is not JSON", seconds)
    if not isinstance(value, dict):
        return Probe(None, "the body is not a JSON object", seconds)
    return Probe(value, "", seconds)


# --- the examination --------------------------------------------------------------------------------------------------


class _Examination:
    def __init__(
        self, url: str, cfg: CaptionConfig, vocabulary: Vocabulary, ways: Sequence[Writing], as_reader: bool
    ) -> None:
        self.cfg, self.vocabulary, self.ways, self.as_reader = cfg, vocabulary, ways, as_reader
        self.takes_schema = cfg.endpoint.json_schema
        self.engine = ChatClient(url, cfg.endpoint)
        [self.client] = self.engine.servers
        self.findings: list[Finding] = []
        self.tokens_per_image: int | None = None
        self.num_images = cfg.num_images
        self.num_drawn = 0
        self.last_detail = ""  # of a trial that got no answer

    async def run(self) -> list[Finding]:
        try:
            await self.engine.start()
        except TeacherError as error:
            return [Finding("model", "unusable", str(error))]
        else:
            self._add("model", "ok", self.client.model)
            if await self._text():
                await self._cut()
                await self._schema()
                if self.as_reader:
                    await self._reading()
                elif await self._image() and await self._many_images() and await self._largest_prompt():
                    await self._writing()
        finally:
            await self.engine.close()
        return self.findings

    def _add(self, name: str, state: State, detail: str) -> None:
        self.findings.append(Finding(name, state, detail))

    async def _ask(self, messages: list[dict], max_tokens: int, schema: dict | None = None) -> Probe:
        endpoint = self.cfg.endpoint.model_copy(update={"max_tokens": max_tokens})
        request = endpoint.request(messages, [], schema or {}, seed=0)  # sampled as a run samples
        body = request_body(self.client.model, request)
        if schema is not None:
            body["response_format"] = response_format(schema)
        probe = Probe(None, "", 0.0)
        for attempt in range(TRIES):
            start_s = time.monotonic()
            try:
                response = await self.client.send(body)
            except (TimeoutError, httpx.RequestError) as error:
                probe = Probe(None, self.client.clean(f"{type(error).__name__} {error}"), time.monotonic() - start_s)
            else:
                probe = read_probe(response, request, self.client, time.monotonic() - start_s)
                if probe.refusal is None or not probe.refusal.may_pass:
                    return probe
            if attempt + 1 < TRIES:
                await asyncio.sleep(self.cfg.endpoint.backoff_s)
        return probe

    # --- the checks, in order ---

    async def _text(self) -> bool:
        probe = await self._ask([_user("Reply with the one word: ready")], self.cfg.endpoint.max_tokens)
        if not probe.text.strip():
            self._add("answers", "unusable", probe.detail or self._emptiness(probe))
            return False
        self._add("answers", "ok", f"in {probe.seconds:.1f} s: {probe.text.strip()[:40]!r}")
        if probe.prompt_tokens is not None:
            self._add("token usage", "ok", "reported")
        else:
            detail = "not reported: --max-cost and --max-tokens cannot be kept, --plan knows no tokens"
            self._add("token usage", "warning", detail)
        if probe.thoughts or "<think" in probe.text:
            length = len(probe.thoughts) or len(probe.text)
            self._add("thinking", "warning", f"on: {length} characters before the answer; switch it off: {NO_THINKING}")
        else:
            self._add("thinking", "ok", "off")
        return True

    def _emptiness(self, probe: Probe) -> str:
        """Say what is there in place of an answer's text."""
        if probe.thoughts:
            limit = self.cfg.endpoint.max_tokens
            return f"{len(probe.thoughts)} characters of thinking and no answer within {limit} tokens: {NO_THINKING}"
        return (
            f"an empty answer, which ends with {probe.finish_reason!r}" if probe.message else "no message in the answer"
        )

    async def _cut(self) -> None:
        probe = await self._ask([_user("Write the numbers from one to two hundred in words.")], 8)
        state: State = "ok" if probe.finish_reason == "length" else "warning"
        detail = repr(probe.finish_reason) if probe.value is not None else probe.detail
        text = f"an answer cut at 8 tokens says {detail}"
        self._add(
            "finish reason", state, text + ("" if state == "ok" else ", not 'length': cut answers count as broken")
        )

    async def _schema(self) -> None:
        schema = {
            "type": "object",
            "properties": {"animal": {"type": "string", "enum": [ODD_WORD]}, "legs": {"type": "integer", "enum": [7]}},
            "required": ["animal", "legs"],
            "additionalProperties": False,
        }
        probe = await self._ask([_user("Hello! How are you today?")], 256, schema)
        if probe.refusal is not None and probe.refusal.may_be_schema:
            self.takes_schema = False
            self._add("JSON schema", "warning", f"refused ({probe.detail}); answers are parsed from plain text")
            return
        if probe.value is None:
            self._add("JSON schema", "warning", f"could not be tried: {probe.detail}")
            return
        try:
            is_applied = parse_json(probe.text) == {"animal": ODD_WORD, "legs": 7}
        except ValueError:
            is_applied = False
        if is_applied:
            self._add("JSON schema", "ok", "applied: the answer had a shape that the model would not choose")
            return
        self._add(
            "JSON schema",
            "warning",
            f"accepted and ignored: asked for {{animal: {ODD_WORD}}}, got {probe.text.strip()[:40]!r}; answers are "
            f"parsed from plain text, an anchored decision is not enforced",
        )

    async def _image(self) -> bool:
        question = "What colour is the image? One word."
        with_image = await self._ask([_user(question, self._pictures(1))], 32)
        if with_image.value is None:
            self._add("image input", "unusable", f"refused: {with_image.detail}")
            return False
        without = await self._ask([_user(question)], 32)
        if with_image.prompt_tokens is None or without.prompt_tokens is None:
            self._add("image input", "warning", "accepted; whether it was looked at cannot be told without token usage")
            return True
        self.tokens_per_image = with_image.prompt_tokens - without.prompt_tokens
        if self.tokens_per_image <= 0:
            self._add("image input", "unusable", "accepted and ignored: the prompt did not grow by a token")
            return False
        side = self.cfg.image.max_side_px
        self._add("image input", "ok", f"{self.tokens_per_image} tokens for one of {side}x{side * 9 // 16}")
        return True

    async def _many_images(self) -> bool:
        """Find how many images a prompt may hold, up to what we send."""
        low, high = 1, self.num_images + 1  # low works, high does not
        tried, refusal, dropped = self.num_images, "", ""
        while high - low > 1:
            probe = await self._ask([_user("Reply with the one word: ready", self._pictures(tried))], 8)
            if probe.is_too_long:  # it says nothing of how many it takes
                self._add("largest prompt", "unusable", f"{tried} pictures alone are too much: {probe.detail}")
                return False
            if probe.value is not None:
                low, dropped = tried, self._dropped(probe, tried)
            else:
                high, refusal = tried, probe.detail
            tried = (low + high) // 2
        if low >= self.num_images:
            detail = dropped or f"{low}, as many as our prompts hold"
            self._add("images per prompt", "warning" if dropped else "ok", detail)
            return True
        self._add(
            "images per prompt",
            "unusable",
            f"{low}, our prompts hold {self.num_images} ({refusal}); raise the server's limit (vLLM: "
            f"--limit-mm-per-prompt "
            f"'{{\"image\": {self.num_images}}}'), or set image.layout=tiled or fewer image.modalities",
        )
        return False

    def _dropped(self, probe: Probe, count: int) -> str:
        """Some servers drop images beyond a limit in silence: the token count shows it. Gives the finding, or ""."""
        if self.tokens_per_image and probe.prompt_tokens and probe.prompt_tokens < 0.8 * count * self.tokens_per_image:
            return (
                f"{count} images took {probe.prompt_tokens} tokens, one takes {self.tokens_per_image}: some were "
                f"dropped"
            )
        return ""

    async def _largest_prompt(self) -> bool:
        """Send a prompt as long as ours get, with our answer limit and schema."""
        limit = self.cfg.endpoint.max_tokens
        messages = largest_messages(self.cfg, self.vocabulary, self._pictures(self.num_images))
        way = way_of(self.cfg.writing, self.vocabulary)
        more = more_fields(way)
        schema = answer_schema(self.vocabulary.actions, more=more) if self.takes_schema else None
        probe = await self._ask(messages, limit, schema)
        length = self.client.context
        known = f" of {length} that the model holds" if length else ""
        if probe.value is None:
            self._add("largest prompt", "unusable", f"with {limit} tokens for the answer{known}: {probe.detail}")
            return False
        used = probe.prompt_tokens
        fix = MEANINGS["too_long"].fix
        if length and used is not None and used + limit > length:
            self._add(
                "largest prompt", "unusable", f"{used} tokens and {limit} for the answer, more than {length}: {fix}"
            )
            return False
        written = probe.completion_tokens
        if probe.finish_reason == "length" and used and written and written < limit:
            self._add("largest prompt", "unusable", f"its answer was cut after {written} of {limit} tokens: {fix}")
            return False
        self._add("largest prompt", "ok", f"{used or 'unknown'} tokens and {limit} for the answer{known}")
        parsed = parse_answer(probe.text, self.vocabulary.actions, more=more, optional=way.optional)
        state: State = "ok" if parsed.coc is not None else "warning"
        mended = f", after mending {', '.join(parsed.recovered)}" if parsed.recovered else ""
        detail = f"{parsed.reason or 'of the right structure'}{mended}; {probe.seconds:.1f} s, {probe.finish_reason!r}"
        self._add("answer to it", state, detail)
        return True

    async def _writing(self) -> None:
        """Find what it can write: slots, claims or prose."""
        results = await try_ways(self._written, self.cfg, self.vocabulary, self.ways)
        for result in results:
            silent = f" ({self.last_detail})" if NO_ANSWER in result.reasons else ""
            self._add(f"writes {result.writing}", "ok" if result.is_enough else "warning", result.detail + silent)
        best, chosen = best_way(results), self.cfg.writing
        if best is None:
            self._add("writing", "warning", "no trial answer passed: most windows would be dropped")
        elif best == chosen:
            self._add("writing", "ok", f"{chosen}, as set")
        else:
            self._add("writing", "warning", f"set to {chosen}; use --set caption.writing={best}")

    async def _reading(self) -> None:
        """Find whether it reads true captions into claims."""
        gold = [caption.model_copy(update={"errors": ()}) for caption in read_gold() if caption.claims][:READ_CAPTIONS]
        model = AskedModel(KeptAnswers(self.engine, None), self.cfg.reader, 0)
        check = await measure_reader(Reader([model], self.vocabulary), gold)
        is_good = not check.num_unreadable and not check.num_flagged and check.num_claims >= check.num_sentences
        self._add(
            "reads prose",
            "ok" if is_good else "warning" if check.num_claims else "unusable",
            f"{check.num_claims / check.num_sentences:.1f} claims a sentence in both readings, {check.num_flagged} of "
            f"{check.num_true} true captions "
            f"flagged, {check.num_unreadable} of {check.num_requests} answers without claims; measure it: cosfly "
            f"caption reader-check",
        )

    async def _written(self, messages: list[dict], schema: dict) -> tuple[str, bool] | None:
        limit = self.cfg.endpoint.max_tokens
        probe = await self._ask(messages, limit, schema if self.takes_schema else None)
        if probe.value is None:
            self.last_detail = probe.detail
            return None
        return probe.text, probe.finish_reason == "length"

    def _pictures(self, count: int) -> list[dict]:
        """Make pictures of our size, each unlike all before it: a cache does not answer for them, nor refuse them.

        After a prompt that was too long vLLM answers 500 to any other with the same pictures (its issue 43941).
        """
        side = self.cfg.image.max_side_px
        width = side * (len(self.cfg.image.modalities) if self.cfg.image.layout == "tiled" else 1)
        self.num_drawn += count
        return [_picture(width, side * 9 // 16, self.num_drawn - left) for left in range(count, 0, -1)]


def largest_messages(cfg: CaptionConfig, vocabulary: Vocabulary, pictures: list[dict]) -> list[dict]:
    """Give messages as long as ours get: a made-up window whose numbers have many digits."""
    count = cfg.window.num_frames
    far = np.full((count, 3), -12345.67) + np.arange(count)[:, None]
    window = ObservedWindow(
        sample_id="doctor_ORI_frame_00004",
        town="doctor",
        trajectory="doctor",
        variant="ORI",
        indices=tuple(range(count)),
        width_px=1280,
        height_px=720,
        frames=observed_frames(
            0.5 * np.arange(count),
            far,
            np.tile([-123.4, -123.4, -123.4], (count, 1)),
            far + 100.0,
            np.tile([1234.5, 654.3], (count, 1)),
            np.tile([1200.0, 600.0, 1260.0, 700.0], (count, 1)),
            np.ones(count, bool),
            np.ones(count, bool),
            np.full(count, 0.5),
        ),
        frame_folders=tuple(Path(f"frame_{i:05d}") for i in range(count)),
        frame_files=tuple(frozenset(VIEW_FILES.values()) for _ in range(count)),
    )
    question = make_question(window, cfg.image, cfg.writing, vocabulary)
    content = [*pictures, {"type": "text", "text": text_of(question)}]
    messages: list[dict] = [
        {"role": "system", "content": way_prompt(question.way)},
        {"role": "user", "content": content},
    ]
    if not cfg.correction_asks:
        return messages
    words = "Nothing has to change. " * (MAX_RETURNED_CHARACTERS // 23)
    return messages + correction_messages(Correction(words, words[:MAX_COMPLAINT], 1), vocabulary)


def _user(text: str, pictures: list[dict] | None = None) -> dict:
    return {"role": "user", "content": [*pictures, {"type": "text", "text": text}] if pictures else text}


def _picture(width: int, height: int, number: int) -> dict:
    image = np.full((height, width, 3), (40, 40, 200), np.uint8)
    cv2.putText(image, str(number), (width // 8, height // 2), cv2.FONT_HERSHEY_SIMPLEX, 2.0, (255, 255, 255), 3)
    done, data = cv2.imencode(".jpg", image)
    assert done
    url = f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
    return {"type": "image_url", "image_url": {"url": url}}
