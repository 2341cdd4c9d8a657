"""YAML of settings: what JSON can say, in YAML's spelling, with comments and anchors.

Settings are the user's own. A tag, a key that is given twice and a key that is no plain word are errors; a date is the
text that it looks like.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from cosfly.runtime.errors import ConfigError

MOST_BYTES = 1_000_000  # a run's settings are some 10 kB; the longest word list that ships has 100


class _Loader(yaml.SafeLoader):
    """The safe loader, with keys that are given once."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen = set[str]()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key that is no word", key.start_mark)
            if key.value in seen and key.value != "<<":
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


# Only what JSON has: without the resolver a date stays text, which is what its users mean.
_KINDS = {f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float", "str", "seq", "map", "merge")}
_Loader.yaml_constructors = {
    tag: constructor for tag, constructor in yaml.SafeLoader.yaml_constructors.items() if tag is None or tag in _KINDS
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag in _KINDS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, where: str | Path, *, what: str = "configuration") -> Any:
    """Read YAML text.

    Raises:
        ConfigError: it is not valid, or too long.
    """
    if len(text) > MOST_BYTES:
        expected = f"at most {MOST_BYTES / 1e6:g} MB"
        raise ConfigError(f"the {what} is too long", where=where, got=f"{len(text) / 1e6:.1f} MB", expected=expected)
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"the {what} is not valid YAML", where=where, got=str(error)) from None
