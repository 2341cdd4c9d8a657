"""The commands `cosfly sim ...`: servers of our own that speak a simulator's protocol."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

app = typer.Typer(help="Simulators without Unreal and GPU: servers for trying client code.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keep `serve` a command of its own, however few there are."""


@app.command("serve")
def sim_serve(
    town: Annotated[Path, Argument(metavar="TOWN", help="Map: boxes_3d.json.")],
    host: Annotated[str, Option(help="Address to listen at; only this machine by default.")] = "127.0.0.1",
    port: Annotated[int, Option(min=1, max=65534, help="Port of calls; streams of sensors are at the next.")] = 2000,
    protocol: Annotated[
        Literal["carla", "unrealcv"], Option(help="Whose client it is for; UnrealCV's has one port.")
    ] = "carla",
    fault: Annotated[
        list[str] | None,
        Option(metavar="NAME[:SENSOR]@TICK[+][=SECONDS]", help="Plant a fault, as drop:depth@3 or die@9; repeat it."),
    ] = None,
) -> None:
    """A server over a town of boxes, for an unmodified client of CARLA 0.9.16 or of UnrealCV: actors and cameras."""
    from cosfly.products.boxes import read_boxes
    from cosfly.simulators.carla import server as carla
    from cosfly.simulators.serving import Fault
    from cosfly.simulators.unrealcv import server as unrealcv

    faults = [Fault.of(text, (carla if protocol == "carla" else unrealcv).FAULTS) for text in fault or []]
    make = carla.CarlaServer if protocol == "carla" else unrealcv.UnrealCvServer
    server = make(read_boxes(town), host, port, faults)
    typer.echo(f"{server.town} at {host}:{port}")
    server.serve()
