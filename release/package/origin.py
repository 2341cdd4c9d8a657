"""Where a release comes from, as its record says it: stages with their settings, seeds and versions, without anything of this machine."""

from __future__ import annotations

import platform
from collections.abc import Mapping

import numpy as np
import pyarrow as pa

import cosfly
from cosfly.work.provenance import StageInput, stages_behind
from release.package.captions import CaptionAccount, teacher_settings
from release.package.publishable import published
from release.package.sources import Source, input_names
from release.record import MadeBy, Provenance, Repairs, SourceRecord, Teacher

DIGITS = 4  # of shares


def provenance_of(sources: list[Source], inputs: Mapping[str, StageInput], account: CaptionAccount) -> Provenance:
    """Give what the record says of the sources and of all their captions.

    Args:
        inputs: of the stage, by their names (`input_names`).
    Raises:
        InputError: a stage's record cannot be read.
    """
    repaired = dict(sorted(account.repairs.items()))
    first = account.accepted - sum(repaired.values())
    parts = {"first_answers": first, **{f"repaired: {rung}": count for rung, count in repaired.items()}}
    return Provenance(
        versions={
            "cosfly": cosfly.__version__,
            "python": platform.python_version(),
            "pyarrow": pa.__version__,
            "numpy": np.__version__,
        },
        sources=[_source(source, names, inputs) for source, names in zip(sources, input_names(sources), strict=True)],
        teachers=[
            Teacher(kind=kind, model=model, settings=published(teacher_settings(settings)), captions=count)
            for (kind, model, settings), count in sorted(account.teachers.items())
        ],
        repairs=Repairs(
            accepted=account.accepted,
            first_answers=first,
            repaired_by_rung=repaired,
            shares={name: round(count / account.accepted, DIGITS) for name, count in parts.items() if account.accepted},
        ),
        tokens=dict(sorted(account.tokens.items())),
        asks=account.asks,
    )


def _source(source: Source, names: dict[str, str], inputs: Mapping[str, StageInput]) -> SourceRecord:
    sha256 = {role: inputs[name].sha256 for role, name in names.items()}
    return SourceRecord(
        run=source.run,
        tree_sha256=sha256["data"],
        captions_sha256=sha256["captions"],
        inspect_sha256=sha256.get("inspect"),
        review_sha256=sha256.get("review"),
        stages=[
            MadeBy(
                stage=record.stage,
                code_version=record.code_version,
                seed=record.seed,
                config=published(record.config),
                inputs={name: made_of.sha256 for name, made_of in record.inputs.items()},
            )
            for record in stages_behind(source.files.values())
        ],
    )
