"""The commands `cosfly teacher ...`: servers of a model, for `--teacher`."""

from __future__ import annotations

from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli.options import Job, Sets, takes

app = typer.Typer(help="Servers of a teacher's model: started, watched, started anew, ended.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keep `serve` a command of its own, however few there are."""


@app.command("serve")
@takes()
def teacher_serve(
    job: Job,
    model: Annotated[str, Argument(help="Model folder, or a repository's name.")],
    arguments: Annotated[
        list[str] | None,
        Argument(help="Further arguments of `vllm serve`, after --.", show_default=False),
        Sets("caption.serve.arguments"),
    ] = None,
    replicas: Annotated[
        int | None, Option(help="Servers, each on GPUs of its own, at ports in a row."), Sets("caption.serve.replicas")
    ] = None,
    gpus: Annotated[
        int | None, Option(help="GPUs of one server (tensor parallel)."), Sets("caption.serve.gpus")
    ] = None,
    port: Annotated[int | None, Option(help="Port of the first server."), Sets("caption.serve.port")] = None,
    host: Annotated[
        str | None, Option(help="Address to listen at; 0.0.0.0 for other machines."), Sets("caption.serve.host")
    ] = None,
) -> None:
    """Start vLLM servers and watch them until Ctrl-C; prints what --teacher takes once all answer."""
    from cosfly.chat.supervisor import LOOK_S, TeacherServers

    cfg = job.cfg.caption
    with TeacherServers(model, cfg.serve, cfg.num_images) as servers:
        typer.echo(f"--teacher {servers.urls}")
        while not servers.stop.wait(LOOK_S):
            servers.check()
