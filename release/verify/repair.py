"""`--repair-plan`: what of the findings could be mended, and how. Nothing is changed."""

from __future__ import annotations

from release.verify.findings import Verified

# code -> (can it be mended without making anything anew, how)
AGAIN, REBUILD = "fetch the file again from where the release is published", "build the release again from its runs"
PLANS: dict[str, tuple[bool, str]] = {
    **dict.fromkeys(("missing", "size", "checksum", "unreadable"), (True, f"{AGAIN} (cosfly release get resumes), or {REBUILD}")),
    "unexpected": (True, "move it out of the folder"),
    "card": (True, "write README.md again: cosfly release card gives it from release.json"),
    **dict.fromkeys(("columns", "rows", "shard_name", "digest"), (False, REBUILD)),
    **dict.fromkeys(("number", "sum", "split", "frames", "flight"), (False, f"{REBUILD}: its record is not of its shards")),
    "picture": (False, "render the frame again, inspect, and build again"),
    **dict.fromkeys(
        ("prompt", "caption_text", "languages", "label", "verdict", "window", "caption", "decision", "sentences"),
        (False, "caption the flight again from its tree, and build again"),
    ),
    "leak": (False, "build again: splits are handed out by walk"),
    "signature": (False, f"{AGAIN}, or ask its maker to sign it: cosfly release sign"),
    "licence": (True, "name licence and credits of the maps: release.licence and release.credits of the build"),
}  # fmt: skip
ELSE = (False, "no file of the folder tells what was true: render or build the flights that are named again")


def plan_of(report: Verified) -> list[str]:
    """Give one line for each kind of error; none where nothing is wrong."""
    lines = []
    for kind in report.kinds:
        if kind.severity != "error":
            continue
        can_be_mended, how = PLANS.get(kind.code, ELSE)
        lines.append(
            f"{kind.code} ({kind.count:,}): {'could be mended' if can_be_mended else 'not to be mended here'}: {how}"
        )
    return lines
