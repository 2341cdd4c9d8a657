"""Gymnasium environments in which a policy follows a pedestrian: `import cosfly.envs`, then `gymnasium.make(ENV)`.

They render, simulate and measure as `cosfly fly` does, and need neither a GPU nor a simulator.
"""

from cosfly.envs.episodes import TASKS
from cosfly.runtime.errors import EnvironmentMissing

try:
    import gymnasium
except ImportError as error:
    fix = 'pip install -e ".[envs]"'
    raise EnvironmentMissing("Gymnasium is not installed", got=str(error), fix=fix) from None

_FLAT = {"observation": "flat", "size_px": (96, 54)}  # for trainers that take one array
for _task in TASKS:
    for _name, _fixed in ((_task, {}), (_task.replace("-v0", "Flat-v0"), _FLAT)):
        if _name not in gymnasium.registry:
            gymnasium.register(_name, entry_point="cosfly.envs.follow:FollowEnv", kwargs={"task": _task, **_fixed})
