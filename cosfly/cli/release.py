"""The commands `cosfly release ...` and `cosfly export ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import WORKERS, Job, Sets, takes

app = typer.Typer(no_args_is_help=True, help="Package captions and frames as a data set that opens with one line.")
ReleaseFolder = Annotated[Path, Argument(help="Release folder, or a run with one.")]


@app.command("build")
@takes(*WORKERS, "resume")
def release_build(
    job: Job,
    out: Annotated[Path, Option(help="Release folder.")],
    runs: Annotated[
        list[Path] | None, Argument(help="Run folders, as `cosfly run` makes them; all go into one release.")
    ] = None,
    captions: Annotated[
        list[Path] | None, Option(help="captions.jsonl of a tree; repeat with --data for several.")
    ] = None,
    inspected: Annotated[
        list[Path] | None,
        Option("--inspect", help="inspect.json of a tree, one for each or none: then all flights are released."),
    ] = None,
    data: Annotated[
        list[Path] | None,
        Option(help="Playback tree, also of others; by default that of the run folder one stands in."),
    ] = None,
    flights: Annotated[
        list[str] | None, Option(metavar="GLOB", help=options.GLOB_HELP), Sets("release.flights")
    ] = None,
    tracks: Annotated[
        options.TrackOption | None, Option(help=options.TRACKS_HELP), Sets("release.tracks", options.TRACKS)
    ] = None,
    frames: Annotated[
        str | None,
        Option(metavar="N|all", help="Frames of each flight, in evenly spread runs; or all of them."),
        Sets("release.num_frames", {"all": None}),
    ] = None,
) -> None:
    """Select frames of one run or several, join captions, write parquet, data-set card and checksums."""
    from release.package import stage as package
    from release.package.sources import Source

    sources = [Source.of_run(folder) for folder in runs or []]
    if captions or inspected or data or not sources:
        trees = data or [job.tree(None)]
        inspections: list[Path | None] = list(inspected) if inspected else [None for _ in trees]
        if not len(trees) == len(captions or []) == len(inspections):
            raise typer.BadParameter(
                "give --data and --captions, and --inspect or none, one of each for a tree; or run folders"
            )
        sources += [Source.of_files(*files) for files in zip(trees, captions or [], inspections, strict=True)]
    job.finish(package.run(job.cfg.release, sources, out, **job.worker_options), out)


@app.command("verify")
@takes(*WORKERS)
def release_verify(
    job: Job,
    folder: Annotated[
        Path,
        Argument(help="Release folder, a run with one, playback tree, or export of a release; the hub's cache too."),
    ],
    level: Annotated[
        str,
        Option(
            help="structure: names, sizes, records, card. rows: every row too. pixels: checksums and every picture too."
        ),
    ] = "pixels",
    json_file: Annotated[Path | None, Option("--json", help="Write the findings for machines here.")] = None,
) -> None:
    """Check that a release is what its records say and can be true, from cheap to dear. Exit 1 if anything is wrong."""
    from caption.run.released import read_released
    from cosfly.pipeline.settings import worker_options
    from cosfly.runtime.json_io import write_json
    from release.verify.verify import LEVELS, verify

    if level not in LEVELS:
        raise typer.BadParameter(f"one of {', '.join(LEVELS)}", param_hint="--level")
    report = verify(folder, level=level, reader=read_released, **worker_options(job.cfg))
    typer.echo(str(report))
    if json_file is not None:
        write_json(json_file, report.as_json())
    if not report.is_ok:
        raise typer.Exit(1)


@app.command("stats")
@takes()
def release_stats(
    job: Job,
    folder: ReleaseFolder,
    out: Annotated[Path, Option(help="Folder for stats.html, stats.md and stats.json.")],
    pixels: Annotated[
        int,
        Option(min=0, help="Frames whose depth and instance pictures are decoded, spread evenly; 0 for none."),
    ] = 200,
) -> None:
    """Compute the tables of the paper that a release can tell again from the rows, and draw what is covered."""
    from release.stats import stats

    typer.echo(stats.run(folder, out, pixels=pixels))


@app.command("export")
@takes(*WORKERS, "resume")
def release_export(
    job: Job,
    source: Annotated[Path, Argument(help="Release; for captions alone also a run directory or captions.jsonl.")],
    out: Annotated[Path, Option(help="Output directory; of captions the file.")],
    format: Annotated[
        Literal["tree", "webdataset", "lerobot", "csv", "jsonl", "sharegpt", "llava"],
        Option(
            help="Playback tree (CosFly-Track v7), WebDataset or LeRobot v3.0; captions alone as a table, JSON lines, "
            "or conversations for LLaMA-Factory or LLaVA."
        ),
    ],
    shard_mb: Annotated[int | None, Option(help="Approximate size of a file of many frames, MB.")] = None,
    language: Annotated[Literal["en", "zh", "both"], Option(help="Captions: languages of the texts.")] = "both",
    frames: Annotated[
        Literal["all", "last"], Option(help="Conversations: pictures of all frames of the window, or of the last one.")
    ] = "all",
    split: Annotated[
        Literal["train", "validation", "test"] | None,
        Option(help="Captions: only this split; conversations of one split go to one file."),
    ] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Captions: replace an existing file.")] = False,
) -> None:
    """Write a release in another format, without loss, or its accepted captions to one file."""
    from cosfly.runtime.config import build

    if format == "tree" or format == "webdataset" or format == "lerobot":
        from release.export import stage as export
        from release.export.contract import ExportConfig

        given = {"format": format} | ({} if shard_mb is None else {"shard_mb": shard_mb})
        job.finish(
            export.run(build(ExportConfig, given, "--format, --shard-mb"), source, out, **job.worker_options), out
        )
        return
    from release.columns import LANGUAGES
    from release.export import captions

    languages = LANGUAGES if language == "both" else [language]
    tally = captions.export(source, out, format, languages=languages, shown=frames, split=split, overwrite=overwrite)
    typer.echo(f"{out}: {tally}")
