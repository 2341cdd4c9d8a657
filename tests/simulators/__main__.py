"""Run a server over a map: `python tests/simulators MAP --port N [--protocol unrealcv] [--fault NAME@TICK]...`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main() -> None:
    """Serve until the process ends."""
    sys.path[0] = str(Path(__file__).parents[1])  # this folder's own name is the package's
    from cosfly.products.boxes import read_boxes
    from simulators import carla_server, unrealcv_server
    from simulators.scene import Fault

    parser = argparse.ArgumentParser()
    parser.add_argument("town", type=Path)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--protocol", default="carla")
    parser.add_argument("--fault", action="append", default=[])
    given = parser.parse_args()
    make = carla_server.CarlaServer if given.protocol == "carla" else unrealcv_server.UnrealCvServer
    server = make(read_boxes(given.town), given.port, [Fault.of(text) for text in given.fault])
    print(f"{server.town} at {given.port}", flush=True)
    server.serve()


if __name__ == "__main__":
    main()
