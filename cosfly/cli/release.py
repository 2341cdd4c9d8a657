"""The commands `cosfly release ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from cosfly.cli import options

app = typer.Typer(no_args_is_help=True, help="Package captions and frames as a data set that opens with one line.")


@app.command("build")
def release_build(
    out: Annotated[Path, typer.Option(help="Release folder.")],
    runs: Annotated[
        list[Path] | None, typer.Argument(help="Run folders, as `cosfly run` makes them; all go into one release.")
    ] = None,
    captions: Annotated[
        list[Path] | None, typer.Option(help="captions.jsonl of a tree; repeat with --data for several.")
    ] = None,
    inspected: Annotated[
        list[Path] | None,
        typer.Option("--inspect", help="inspect.json of a tree, one for each or none: then all flights are released."),
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Playback tree, also of others; by default that of the run folder one stands in."),
    ] = None,
    flights: options.Flights = None,
    tracks: options.Tracks = None,
    frames: Annotated[
        str | None, typer.Option(metavar="N|all", help="Frames of each flight, in evenly spread runs; or all of them.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Select frames of one run or several, join captions, write parquet, data-set card and checksums."""
    from release.package import stage as package
    from release.package.sources import Source

    sources = [Source.of_run(folder) for folder in runs or []]
    if captions or inspected or data or not sources:
        trees = data or [options.data_folder(None)]
        inspections: list[Path | None] = list(inspected) if inspected else [None for _ in trees]
        if not len(trees) == len(captions or []) == len(inspections):
            raise typer.BadParameter(
                "give --data and --captions, and --inspect or none, one of each for a tree; or run folders"
            )
        sources += [Source.of_files(*files) for files in zip(trees, captions or [], inspections, strict=True)]
    given_flights = options.chosen_flights("release", flights, tracks)
    chosen = {
        "workers": workers,
        "release.flights": given_flights["release.match"],
        "release.tracks": given_flights["release.tracks"],
    }
    cfg = options.resolve(config, [*(overrides or []), *_frames_setting(frames)], chosen)
    options.set_aside(out, repair)
    options.verify_first(verify, *(path for source in sources for path in source.files.values()), out)
    given = options.manner(cfg, resume)
    options.tell_product(package.run(cfg.release, sources, out, **given), out, cfg)


def _frames_setting(frames: str | None) -> list[str]:
    """Give `--frames` as a setting."""
    if frames is None:
        return []
    if frames != "all" and not frames.isdecimal():
        raise typer.BadParameter(f"--frames takes a number or all, not {frames!r}")
    return [f"release.num_frames={'null' if frames == 'all' else frames}"]


@app.command("verify")
def release_verify(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Release folder, a run with one, playback tree, or export of a release; the hub's cache too."
        ),
    ],
    level: Annotated[
        str,
        typer.Option(
            help="structure: names, sizes, records, card. rows: every row too. pixels: checksums and every picture too."
        ),
    ] = "pixels",
    source: Annotated[
        Path | None,
        typer.Option(help="Of an export: the release it was made of; it is made again and every file compared."),
    ] = None,
    public_key: Annotated[
        Path | None, typer.Option(help="Public key of who should have signed it; all checksums are then compared.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the findings for machines here.")] = None,
    repair_plan: Annotated[
        bool, typer.Option("--repair-plan", help="Say what could be mended, and how; changes nothing.")
    ] = False,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
) -> None:
    """Check that a release is what its records say and can be true, from cheap to dear. Exit 1 if anything is wrong."""
    from caption.run.released import read_released
    from cosfly.app.settings import manner_of_work
    from cosfly.work.store import write_json
    from release.sign import read_public_key
    from release.verify.repair import plan_of
    from release.verify.verify import LEVELS, verify

    if level not in LEVELS:
        raise typer.BadParameter(f"one of {', '.join(LEVELS)}", param_hint="--level")
    cfg = options.resolve(config, overrides, {"workers": workers})
    key = None if public_key is None else read_public_key(public_key)
    report = verify(folder, level=level, reader=read_released, source=source, public_key=key, **manner_of_work(cfg))
    typer.echo(str(report))
    for line in plan_of(report) if repair_plan else []:
        typer.echo(f"repair plan: {line}")
    if json_file is not None:
        write_json(json_file, report.as_json())
    if not report.is_ok:
        raise typer.Exit(1)


@app.command("sign")
def release_sign(
    folder: Annotated[Path, typer.Argument(help="Release folder, or a run with one.")],
    key: Annotated[Path, typer.Option(help="Private ed25519 key, PEM of openssl or ssh-keygen.")],
    level: Annotated[
        Literal["structure", "rows", "pixels"], typer.Option(help="How far the release is verified before.")
    ] = "pixels",
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
) -> None:
    """Verify a release, then sign its list of checksums with your key: `release verify --public-key` tells a forged one."""
    from caption.run.released import read_released
    from cosfly.app.settings import manner_of_work
    from release import sign
    from release.record import release_folder
    from release.verify.verify import verify

    cfg = options.resolve(config, overrides, {"workers": workers})
    private_key = sign.read_private_key(key)
    report = verify(folder, level=level, reader=read_released, **manner_of_work(cfg))
    typer.echo(str(report))
    if not report.is_ok:
        typer.echo("nothing was signed", err=True)
        raise typer.Exit(1)
    typer.echo(sign.sign(release_folder(folder), private_key))


@app.command("stats")
def release_stats(
    folder: Annotated[Path, typer.Argument(help="Release folder, or a run with one.")],
    out: Annotated[Path, typer.Option(help="Folder for stats.html, stats.md and stats.json.")],
    pixels: Annotated[
        int,
        typer.Option(min=0, help="Frames whose depth and instance pictures are decoded, spread evenly; 0 for none."),
    ] = 200,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Compute every table that the paper gives of its data again from the rows, and draw what is covered."""
    from release.stats import stats

    options.resolve(config, overrides)
    typer.echo(stats.run(folder, out, pixels=pixels))


@app.command("card")
def release_card(
    folder: Annotated[Path, typer.Argument(help="Release folder, or a run with one.")],
    out: Annotated[Path | None, typer.Option(help="File to write; by default it is printed.")] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Render the data-set card of a release from its release.json, as `verify` expects it in README.md."""
    from cosfly.work.store import write_bytes
    from release.card.render import render_card
    from release.record import read_record, release_folder

    options.resolve(config, overrides)
    card = render_card(read_record(release_folder(folder) / "release.json"))
    if out is None:
        typer.echo(card, nl=False)
    else:
        write_bytes(out, card.encode())
        typer.echo(out)


@app.command("viewer")
def release_viewer(
    folder: Annotated[Path, typer.Argument(help="Release folder, run folder or playback tree.")],
    out: Annotated[Path, typer.Option(help="The page.")],
    captions: Annotated[
        Path | None, typer.Option(help="captions.jsonl of a playback tree; a run and a release have their own.")
    ] = None,
    flights: Annotated[int, typer.Option(help="Most flights on the page; of more, spread evenly.")] = 100,
    frames: Annotated[int, typer.Option(help="Most frames of a flight.")] = 16,
    picture_px: Annotated[
        int, typer.Option(help="Width of a colour picture, px; depth and mask have half of it.")
    ] = 320,
    max_mb: Annotated[
        int, typer.Option(help="Size of the page, MB: what would make it larger loses its pictures.")
    ] = 64,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Make one page that works offline: flights, frames (colour, depth, mask), tracks from above, captions with verdict and evidence, filters."""
    from cosfly.work.config import build
    from release.viewer import page
    from release.viewer.content import ViewerConfig

    options.resolve(config, overrides)
    chosen = {"flights": flights, "frames": frames, "picture_px": picture_px, "max_mb": max_mb}
    written = page.run(folder, out, build(ViewerConfig, chosen, "the options"), captions)
    typer.echo(f"{written}: {written.stat().st_size / 1e6:,.1f} MB")


@app.command("export")
def release_export(
    folder: Annotated[Path, typer.Argument(help="Release folder, or a run with one.")],
    out: Annotated[Path, typer.Option(help="Folder for the export and its records.")],
    format: Annotated[
        Literal["tree", "webdataset", "lerobot"],
        typer.Option(help="Playback tree (CosFly-Track v7), WebDataset or LeRobot v3.0."),
    ],
    shard_mb: Annotated[int | None, typer.Option(help="Size of a file of many frames, about, in MB.")] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Write a release in another format, without loss, with its licence and where it came from."""
    from cosfly.work.config import build
    from release.export import stage as export
    from release.export.contract import ExportConfig

    cfg = options.resolve(config, overrides, {"workers": workers})
    options.set_aside(out, repair)
    options.verify_first(verify, folder, out)
    given = {"format": format} | ({} if shard_mb is None else {"shard_mb": shard_mb})
    product = export.run(build(ExportConfig, given, "--format, --shard-mb"), folder, out, **options.manner(cfg, resume))
    options.tell_product(product, out, cfg)


@app.command("get")
def release_get(
    source: Annotated[
        str,
        typer.Argument(
            help="Release folder, a run with one, or an address: https://..., hf://datasets/..., zip://::..."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the release and its records.")],
    town: Annotated[list[str] | None, typer.Option(help="Only this town; repeat for more.")] = None,
    split: Annotated[list[str] | None, typer.Option(help="Only this split: train, validation, test; repeat.")] = None,
    flight: Annotated[
        list[str] | None, typer.Option(help="Only this run/town/trajectory, with its twin flights; repeat.")
    ] = None,
    modality: Annotated[
        list[str] | None,
        typer.Option(help="Only these pictures: rgb, depth, instance; repeat. Others do not travel."),
    ] = None,
    digest: Annotated[
        str | None, typer.Option(help="Content digest that the release must have, 12 characters of it or more.")
    ] = None,
    findings: Annotated[
        Literal["refuse", "accept"],
        typer.Option(help="What rows say that cannot be true: refuse the release, or keep it and say so."),
    ] = "refuse",
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
    resume: options.Resume = "if-same",
) -> None:
    """Fetch a release, or some towns, splits, flights and pictures of it; only these travel, and all that can be checked is."""
    from cosfly.work.config import build
    from release.get import stage as get
    from release.get.stage import Choice

    cfg = options.resolve(config, overrides, {"workers": workers})
    asked = {"towns": town, "splits": split, "flights": flight, "modalities": modality, "expected": digest}
    choice = build(Choice, {name: value for name, value in asked.items() if value}, "the options")
    product = get.run(choice, source, out, **options.manner(cfg, resume), findings=findings)
    options.tell_product(product, out, cfg)


@app.command("push")
def release_push(
    folder: Annotated[Path, typer.Argument(help="Release folder, or a run with one.")],
    repo: Annotated[str, typer.Option(help="Repository of data on the hub: OWNER/NAME; made if there is none.")],
    yes: Annotated[bool, typer.Option("--yes", help="Send it. Without: only say what would go.")] = False,
    public: Annotated[
        bool, typer.Option("--public", help="A repository that is made is public; else private.")
    ] = False,
    level: Annotated[
        Literal["structure", "rows", "pixels"], typer.Option(help="How far the release is verified before.")
    ] = "pixels",
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
) -> None:
    """Send a release to a hub that speaks the Hugging Face protocol; verified first, and a dry run without --yes."""
    from caption.run.released import read_released
    from cosfly.work.console import answer_console
    from release import push

    cfg = options.resolve(config, overrides, {"workers": workers})
    push.check_name(repo)
    parcel = push.pack(folder)
    rows = [(name, f"{size:>15,}") for name, size in parcel.files.items()]
    answer_console.print(options.plain_table(f"{len(rows)} files, {parcel.num_bytes / 1e6:,.1f} MB, to {repo}", rows))
    for name in parcel.stays:
        answer_console.print(f"stays here, as it is not of the release: {name}", soft_wrap=True)
    num_workers = options.manner(cfg, "never")["workers"]
    report = push.verified(parcel, level, workers=num_workers, reader=read_released)
    typer.echo(str(report))
    if yes:
        typer.echo(push.push(parcel, repo, private=not public))
    else:
        typer.echo(
            f"dry run: nothing was sent; with --yes it goes to {repo}, {'public' if public else 'private'} if it is made"
        )
