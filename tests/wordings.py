"""The wordings of captions whose truth is known, for `caption/truth/prose/wording.py`.

    python tests/wordings.py

Writes `en_wordings.txt` and `zh_wordings.txt` anew from the gold sets, their planted errors, our own sentences, the rule teacher's and
the foreign captions in ../shared: as few sentences as hold all groups of neighbouring words. The sixth, ninth, tenth and twelfth to eighteenth set are left out, so that they tell what
becomes of wordings that were not met.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
import yaml
from specimens_captions import write_answers
from specimens_prose import CASES, EIGHTH_SET, ELEVENTH_SET, FIFTH_SET, FOURTH_SET, SECOND_SET, SEVENTH_SET, THIRD_SET

from caption.schema import WindowConfig
from caption.truth.facts import measure_facts
from caption.truth.glossary import LANGUAGES
from caption.truth.gold import GOLD_PROSE, read_gold_prose
from caption.truth.prose import wording
from caption.truth.prose.clauses import parse
from caption.truth.prose.numerals import masked
from caption.truth.prose.wording import groups_of, written
from caption.windows import cut_windows
from cosfly.products.captions import Coc, Language
from cosfly.products.sentences import sentences_of
from specimens import make_flight

NUM_FLIGHTS = 20  # of the rule teacher's captions
SETS = (GOLD_PROSE, SECOND_SET, THIRD_SET, FOURTH_SET, FIFTH_SET, SEVENTH_SET, EIGHTH_SET, ELEVENTH_SET)
OWN = Path(__file__).with_name("prose_true.yaml")
FOREIGN = Path(__file__).resolve().parents[2] / "shared" / "data" / "free-prose" / "captions.jsonl"


def captions_here(without: Collection[Path] = ()) -> Iterator[tuple[Language, Coc]]:
    """Yield the captions of the repository, true ones and those with an error planted."""
    for path in SETS:
        if path in without:
            continue
        for line in read_gold_prose(path):
            yield line.language, line.coc
            yield from ((line.language, error.in_text(line.coc)) for error in line.errors)
    yield from rule_captions()
    for entry in yaml.safe_load(OWN.read_text(encoding="utf-8")):
        texts = entry.get("sentences") or [entry["critical_components"], entry["reasoning_trace"]]
        yield from ((entry["lang"], _alone(text)) for text in texts)
    for case in CASES:
        texts = [case.text, *(case.text.replace(old, new, 1) for old, new in case.errors)]
        yield from ((case.language, _alone(text)) for text in texts)


def rule_captions() -> Iterator[tuple[Language, Coc]]:
    """Yield captions of the rule teacher."""
    for seed in range(NUM_FLIGHTS):
        flight, _ = make_flight(30, seed=seed, width_px=640, height_px=360)
        for sample in cut_windows(
            dataclasses.replace(flight, folder=Path("nowhere")), WindowConfig(require_images=False)
        ):
            for answer, language in zip(
                write_answers(measure_facts(sample.observed), np.random.default_rng(seed)), LANGUAGES, strict=True
            ):
                yield language, answer


def foreign_captions() -> Iterator[tuple[Language, Coc]]:
    """Yield those in ../shared."""
    for record in map(json.loads, FOREIGN.read_text(encoding="utf-8").splitlines()):
        for texts in (record, *record["false"]):
            yield record["lang"], Coc(**{name: texts.get(name) or record[name] for name in Coc.model_fields})


def _alone(text: str) -> Coc:
    return Coc(critical_components=text, reasoning_trace="", flight_decision="hover")


def wordings(captions: Iterable[tuple[Language, Coc]]) -> dict[Language, list[str]]:
    """Give the sentences of captions as lines of a wordings file, in their order; of those that add nothing none."""
    lines: dict[Language, list[str]] = {"en": [], "zh": []}
    met: dict[Language, set[tuple[str, ...]]] = {"en": set(), "zh": set()}
    for language, coc in captions:
        for _, text in sentences_of(coc):
            line = written(parse(masked(text, language)[0], language))
            groups = groups_of(line)
            if not groups <= met[language]:
                met[language] |= groups
                lines[language].append(line)
    return lines


def forget(paths: Collection[Path]) -> None:
    """Let the reader go on as if it had not met the wordings of some sets."""
    captions = chain(captions_here(paths), () if FOREIGN in paths else foreign_captions())
    left = {
        language: frozenset(chain.from_iterable(map(wording.groups_of, lines)))
        for language, lines in wordings(captions).items()
    }
    wording.met = left.__getitem__
    wording.is_met.cache_clear()


def main() -> None:
    for language, lines in wordings(chain(captions_here(), foreign_captions())).items():
        wording.wordings_file(language).write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(f"{language}: {len(lines)} sentences")


if __name__ == "__main__":
    main()
