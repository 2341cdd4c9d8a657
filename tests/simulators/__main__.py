"""Run a server over a map: `python tests/simulators MAP --port N [PROTOCOL [FAULT]...]`."""

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).parents[1])  # this folder's own name is the package's
from cosfly.formats.boxes import read_boxes  # noqa: E402
from simulators.carla_server import CarlaServer  # noqa: E402
from simulators.unrealcv_server import UnrealCvServer  # noqa: E402

town, _, port, *rest = sys.argv[1:]
protocol, *faults = rest or ["carla"]
make = CarlaServer if protocol == "carla" else UnrealCvServer
server = make(read_boxes(Path(town)), int(port), faults)
print(f"{server.town.name} at {port}", flush=True)
server.serve()
