"""Tables of what captions say: decisions, verdicts, repairs, evidence, lengths."""

from __future__ import annotations

from cosfly.products.actions import shipped_actions
from cosfly.products.answer_text import MIN_CHARACTERS, MIN_CHARACTERS_ZH
from cosfly.products.captions import FIELDS
from release.columns import LANGUAGE_NAMES, LANGUAGES, STATES
from release.record import ReleaseRecord
from release.stats.cells import SPREAD, Cell, Table, pairs, percent, spread_row
from release.stats.counting import TEXT_BIN, Counts


def of_captions(record: ReleaseRecord, counts: Counts) -> list[Table]:
    """Give the tables."""
    return [
        _decisions(record, counts), _confusion(record, counts), _verdicts(counts), _repairs(counts), _teachers(record), *_evidence(counts), _lengths(counts),
        *_length_bins(counts),
    ]  # fmt: skip


def _decisions(record: ReleaseRecord, counts: Counts) -> Table:
    actions = record.actions or shipped_actions()
    groups = {token: action.group for token, action in actions.actions.items()}
    total, labelled = counts.decisions.total(), counts.labels.total() - counts.labels["none"]
    rows: list[list[Cell]] = [
        [
            name,
            counts.decisions[name],
            percent(counts.decisions[name], total),
            counts.labels[name],
            percent(counts.labels[name], labelled),
            groups.get(name, ""),
        ]
        for name in (*actions.tokens, *sorted(counts.decisions.keys() - {*actions.tokens, "none"}))
    ]
    note = f"Decisions of {total:,} captions, and the labels that the later positions imply for {labelled:,} of them."
    head = ["action", "decisions", "%", "labels", "% ", "group"]
    return Table(
        key="decisions", title="Decisions", paper="tab:coc_actions", note=note, head=head, rows=rows, plot="bars"
    )


def _confusion(record: ReleaseRecord, counts: Counts) -> Table:
    order = [name for name in (*record.closed_set, "none") if counts.labels[name] or counts.decisions[name]]
    rows: list[list[Cell]] = [[label, *(counts.confusion[label, decision] for decision in order)] for label in order]
    return Table(
        key="confusion",
        title="Label (rows) against decision (columns)",
        paper="fig:confusion_patterns",
        head=["label", *order],
        rows=rows,
        plot="heat",
    )


def _verdicts(counts: Counts) -> Table:
    tracks = sorted({track for _, track in counts.verdicts})
    names = ["CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN"]
    names += sorted({name for name, _ in counts.verdicts} - set(names))
    total = counts.verdicts.total()
    rows: list[list[Cell]] = []
    for name in names:
        own = [counts.verdicts[name, track] for track in tracks]
        rows.append([name, sum(own), percent(sum(own), total), *own])
    note = "Of accepted captions, after repair: what the paper's figure shows is of first answers, before it."
    head = ["verdict", "captions", "%", *tracks]
    return Table(
        key="verdicts",
        title="Decision against the geometry",
        paper="fig:consistency_verdict",
        note=note,
        head=head,
        rows=rows,
        plot="bars",
    )


def _repairs(counts: Counts) -> Table:
    total = counts.repairs.total()
    rows: list[list[Cell]] = [[name, count, percent(count, total)] for name, count in counts.repairs.most_common()]
    return Table(
        key="repairs",
        title="Repairs",
        paper="fig:regen_strategy",
        head=["strategy", "captions", "%"],
        rows=rows,
        plot="bars",
    )


def _teachers(record: ReleaseRecord) -> Table:
    made = record.provenance
    rows: list[list[Cell]] = [
        [f"captions of {teacher.kind}: {teacher.model}", teacher.captions] for teacher in made.teachers
    ]
    rows += [["asks", made.asks], *pairs("", [(name.replace("_", " "), count) for name, count in made.tokens.items()])]
    rows += [["first answers that stood", made.repairs.first_answers]]
    rows += [[f"repaired by {rung}", count] for rung, count in made.repairs.repaired_by_rung.items()]
    note = "As the record tells it, of all captions that were read."
    return Table(
        key="teachers", title="Teachers", paper="tab:caption_pipeline", note=note, head=["", "number"], rows=rows
    )


def _evidence(counts: Counts) -> list[Table]:
    tables = []
    kinds = ("all proved", "a contradicted one", "some unread")
    by_state: list[list[Cell]] = [
        [LANGUAGE_NAMES[language], *(counts.sentences[language, state] for state in STATES)] for language in LANGUAGES
    ]
    by_caption: list[list[Cell]] = [
        [LANGUAGE_NAMES[language], *(counts.whole[language, kind] for kind in kinds)] for language in LANGUAGES
    ]
    if counts.sentences:
        note = "Sentences of the captions against the geometry of their flight."
        tables.append(
            Table(
                key="evidence",
                title="Evidence of sentences",
                note=note,
                head=["language", *STATES],
                rows=by_state,
                plot="stacked",
            )
        )
        tables.append(
            Table(
                key="evidence_captions",
                title="Evidence of captions",
                head=["language", *kinds],
                rows=by_caption,
                plot="stacked",
            )
        )
    return tables


def _lengths(counts: Counts) -> Table:
    rows = []
    for language in LANGUAGES:
        least = MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS
        for name in FIELDS[:2]:
            title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}"
            rows.append([*spread_row(title, counts.lengths[language, name].spread()), least[name]])
    note = "Characters. The last column is the least that an answer may have."
    return Table(
        key="text_lengths",
        title="Length of the texts",
        paper="fig:coc_lengths",
        note=note,
        head=["text", *SPREAD[1:], "floor"],
        rows=rows,
    )


def _length_bins(counts: Counts) -> list[Table]:
    tables = []
    for language in LANGUAGES:
        for name in FIELDS[:2]:
            bins = [number for own, field, number in counts.length_bins if (own, field) == (language, name)]
            width = TEXT_BIN[language]
            rows: list[list[Cell]] = [
                [f"{number * width} to {number * width + width - 1}", counts.length_bins[language, name, number]]
                for number in range(min(bins, default=0), max(bins, default=-1) + 1)
            ]
            if rows:
                title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}: characters"
                tables.append(
                    Table(
                        key=f"lengths_{language}_{name}",
                        title=title,
                        paper="fig:coc_lengths",
                        head=["characters", "captions"],
                        rows=rows,
                        plot="bars",
                    )
                )
    return tables
