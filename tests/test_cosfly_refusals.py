"""What the table of refusals makes of the texts of real servers, and what the client does with the schema."""

import itertools
import json
from pathlib import Path

from cosfly.llm.protocol import MEANINGS, MOST_CHARACTERS, Refusal, kind_of

ROWS = Path(__file__).with_name("refusals.tsv").read_text(encoding="utf-8").splitlines()
REFUSALS = [row.replace("\\n", "\n").split("\t") for row in ROWS if not row.startswith("#")]
BODIES = {
    "openai": lambda text, status: json.dumps({"error": {"message": text, "type": "invalid_request", "code": None}}),
    "vllm": lambda text, status: json.dumps({"object": "error", "message": text, "type": "BadRequest", "code": status}),
    "detail": lambda text, status: json.dumps({"detail": text}),
    "list": lambda text, status: json.dumps([{"error": {"code": status, "message": text}}]),
    "plain": lambda text, status: text,
}


def test_a_refusal_is_read_as_what_it_means(subtests):
    for (server, status, kind, text), body in itertools.product(REFUSALS, BODIES):
        with subtests.test(server=server, body=body):
            assert kind_of(int(status), BODIES[body](text, int(status))) == kind


def test_every_meaning_is_in_the_table_and_every_server_once():
    assert {kind for _, _, kind, _ in REFUSALS} == set(MEANINGS)
    assert len({server for server, *_ in REFUSALS}) == len(REFUSALS)


def test_a_request_that_is_sent_back_does_not_name_its_own_fault():
    echoed = json.dumps(
        {"detail": "Bad Request", "input": "x" * MOST_CHARACTERS + "maximum context length, json_schema"}
    )
    assert kind_of(400, echoed) == "unknown"


def test_a_server_that_failed_has_not_filtered_the_window():
    text = "Internal error: failed to load safetensors shard, request flagged for retry by the safety monitor"
    assert kind_of(500, text) == "unknown"
    assert kind_of(400, text) == "content"


def test_a_server_that_is_away_may_come_back_and_a_request_that_is_refused_stays_refused():
    for status in (408, 424, 429, 500, 502, 503, 504, 520, 522, 524, 529, 530, 599):
        assert Refusal(status, kind_of(status, "<html>Error</html>"), "").may_pass
    for status in (400, 401, 403, 404, 413, 422, 451):
        assert not Refusal(status, "unknown", "").may_pass


def test_the_code_of_an_unknown_refusal_is_its_status():
    assert Refusal(400, "unknown", "no").code == "refused_400"
    assert Refusal(400, "too_long", "no").code == "refused_too_long"
