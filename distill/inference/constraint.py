"""Answers that cannot be of another form: what a JSON schema allows next, by llguidance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cosfly.products.answer_text import answer_schema
from cosfly.products.captions import Language
from distill.student.model import Student, require


class SchemaConstraint:
    """Holds the answers of a batch to the schema of their language; see `Constraint` in distill/student/decoding.py."""

    def __init__(self, tokens: Any, grammars: Sequence[str]) -> None:
        """
        Args:
            tokens: llguidance's view of the tokenizer. grammars: of each row.
        """
        from llguidance import LLMatcher

        self._matchers = [LLMatcher(tokens, grammar) for grammar in grammars]

    def allowed(self, rows: Sequence[int], num_tokens: int) -> np.ndarray:
        bits = np.zeros((len(rows), -(-num_tokens // 8)), np.uint8)
        for place, row in enumerate(rows):
            mask = np.frombuffer(self._matchers[row].compute_bitmask(), np.uint8)[: bits.shape[1]]
            bits[place, : len(mask)] = mask
        return bits

    def consume(self, row: int, token: int) -> None:
        matcher = self._matchers[row]
        assert matcher.consume_token(token), matcher.get_error()


class AnswerSchemas:
    """Makes the constraints of batches; texts of a language share their grammar."""

    def __init__(self, student: Student) -> None:
        """
        Raises:
            EnvironmentMissing: llguidance is not installed.
        """
        require("llguidance")
        from llguidance import LLMatcher
        from llguidance.hf import from_tokenizer

        self._tokens = from_tokenizer(student.tokenizer, eos_token=student.end_token_id)
        languages: tuple[Language, ...] = ("en", "zh")
        # Free whitespace would let a student pad for ever.
        self._grammars = {
            language: LLMatcher.grammar_from_json_schema(
                answer_schema(language=language), defaults={"whitespace_flexible": False}
            )
            for language in languages
        }

    def __call__(self, languages: Sequence[Language]) -> SchemaConstraint:
        return SchemaConstraint(self._tokens, [self._grammars[language] for language in languages])
