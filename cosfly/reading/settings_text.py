"""YAML of settings: what JSON can say, in YAML's spelling, with comments and with anchors that stay small.

Refused: tags (`!!binary`), a key that is given twice, keys that are no plain words, and more than a settings file can
need. A date is the text that it looks like. Aliases are counted at the size of what they stand for: nine lines can
stand for a billion values.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from cosfly.errors import ConfigError

# A run's settings are about 400 nodes; the longest word list that ships is 4,000. They are of nobody's data, so nothing
# raises them.
MOST_BYTES, MOST_NODES, MOST_DEPTH, MOST_DIGITS = 1_000_000, 20_000, 32, 40


class _Loader(yaml.SafeLoader):
    """The safe loader, less tags and dates, with limits that hold while it reads."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._num_nodes, self._depth = 0, 0
        self._sizes: dict[str, int] = {}  # anchor -> nodes below it; absent until it is whole

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()
        before = self._num_nodes
        if self.check_event(yaml.AliasEvent):
            if event.anchor in self.anchors and event.anchor not in self._sizes:
                raise yaml.composer.ComposerError(None, None, "an alias inside of what it stands for", event.start_mark)
            self._count(self._sizes.get(event.anchor, 0), event)
            return super().compose_node(parent, index)
        if event.tag not in (None, "!"):
            raise yaml.composer.ComposerError(None, None, f"a tag, {event.tag[:40]!r}", event.start_mark)
        self._count(1, event)
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise yaml.composer.ComposerError(None, None, f"nested deeper than {MOST_DEPTH}", event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor is not None:
            self._sizes[event.anchor] = self._num_nodes - before
        return node

    def _count(self, num: int, event: Any) -> None:
        self._num_nodes += num
        if self._num_nodes > MOST_NODES:
            raise yaml.composer.ComposerError(
                None, None, f"more than {MOST_NODES:,} values, aliases counted at their size", event.start_mark
            )

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen = set[str]()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key that is no word", key.start_mark)
            if key.value in seen and key.value != "<<":
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: Any) -> int:
        if len(node.value) > MOST_DIGITS:
            what = f"a whole number of {len(node.value)} digits"
            raise yaml.constructor.ConstructorError(None, None, what, node.start_mark)
        return super().construct_yaml_int(node)

    def construct_yaml_str(self, node: Any) -> str:
        if "\0" in node.value or any("\ud800" <= letter <= "\udfff" for letter in node.value):
            raise yaml.constructor.ConstructorError(None, None, "a character that no file can hold", node.start_mark)
        return node.value


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:str", _Loader.construct_yaml_str)
# Without the resolver a date stays text, which is what its users mean: no setting is a date.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, where: str | Path, *, what: str = "configuration") -> Any:
    """Read YAML text."""
    if len(text) > MOST_BYTES:
        expected = f"at most {MOST_BYTES / 1e6:g} MB"
        raise ConfigError(f"the {what} is too long", where=where, got=f"{len(text) / 1e6:.1f} MB", expected=expected)
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"the {what} is not valid YAML", where=where, got=str(error)) from None
